"""The laws in C against those in Python, at random states."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake.export import export_c
from systems import CourseController, PlanarVehicleParameters, QuadrotorParameters
from systems.controller import DEFAULT_GAINS
from systems.se3_law import Body, CalcPropellerInput
from tests.c_code import compile_c

COUNT = 400


class Turn(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_double) for name in ("turn_rate", "course", "lateral_acceleration")
    )


@pytest.fixture(scope="module")
def laws(tmp_path_factory, paper_field):
    """The laws as a library, with those of the header as a function."""
    folder = tmp_path_factory.mktemp("laws")
    export_c(paper_field, folder)
    (folder / "defaults.c").write_text(
        '#include "laws.h"\n'
        "const law_quadrotor vehicle = LAW_QUADROTOR;\n"
        "const law_gains gains = LAW_GAINS;\n"
    )
    compile_c(folder, "-O1", "-shared", "-fPIC", "laws.c", "defaults.c", "-lm", "-o", "laws.so")
    library = ctypes.CDLL(str(folder / "laws.so"))
    library.law_course.restype = Turn
    return library


def array(*values):
    return (ctypes.c_double * len(values))(*values)


def se3(laws, state, command, acceleration, disturbance, gains, vehicle):
    numbers = (
        *(vehicle.mass, *vehicle.inertia),
        *(vehicle.arm_length, vehicle.yaw_arm),
        *(vehicle.max_propeller_force, vehicle.force_constant, vehicle.gravity),
    )
    result = array(0, 0, 0, 0)
    laws.law_se3(
        *(array(*values) for values in (state, command, acceleration)),
        None if disturbance is None else array(*disturbance),
        array(*gains[:4]),
        array(*numbers),
        result,
    )
    return np.array(result)


@pytest.mark.parametrize("size", [0.05, 0.5, 3.0])
def test_se3_law(laws, size):
    """From beside hover to where every limit of the law is met."""
    rng = np.random.default_rng(0)
    vehicle = replace(QuadrotorParameters(), force_constant=1.3, moment_constant=0.0104)
    body = Body(vehicle.mass, *vehicle.inertia)
    at_limit = 0
    for _ in range(COUNT):
        state = size * rng.standard_normal(12)
        command, acceleration, disturbance = 2 * size * rng.standard_normal((3, 3))
        gains = DEFAULT_GAINS._replace(heading=2 * size * rng.standard_normal())
        arguments = (state, command, acceleration)
        expected = CalcPropellerInput(
            *(*arguments, (), disturbance, gains, body),
            *(vehicle.rotors, vehicle.gravity, True),
        )
        found = se3(laws, *arguments, disturbance, gains, vehicle)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
        at_limit += (found == 0).any()
    assert (at_limit > 0) == (size > 0.05)


def test_se3_law_without_a_disturbance_and_of_bad_input(laws):
    vehicle, hover = QuadrotorParameters(), np.zeros(12)
    calm = se3(laws, hover, hover[:3], hover[:3], None, DEFAULT_GAINS, vehicle)
    np.testing.assert_allclose(calm, vehicle.hover_force, rtol=1e-14)
    for bad in (np.nan, np.inf):
        for entry in range(12):
            state = hover.copy()
            state[entry] = bad
            forces = se3(laws, state, hover[:3], hover[:3], None, DEFAULT_GAINS, vehicle)
            assert np.isnan(forces).all()
        heading = DEFAULT_GAINS._replace(heading=bad)
        assert np.isnan(se3(laws, hover, hover[:3], hover[:3], None, heading, vehicle)).all()


def test_the_header_has_the_vehicle_and_the_gains_of_python(laws):
    vehicle, rotors = QuadrotorParameters(), QuadrotorParameters().rotors
    stored = (ctypes.c_double * 9).in_dll(laws, "vehicle")
    expected = (vehicle.mass, *vehicle.inertia, *rotors, vehicle.gravity)
    np.testing.assert_array_equal(stored, expected)
    gains = (ctypes.c_double * 4).in_dll(laws, "gains")
    np.testing.assert_array_equal(gains, DEFAULT_GAINS[:4])


def course(laws, heading, velocity, command, feedforward, airspeed, gain):
    turn = laws.law_course(
        ctypes.c_double(heading),
        *(array(*values) for values in (velocity, command, feedforward)),
        ctypes.c_double(airspeed),
        ctypes.c_double(gain),
    )
    return turn.turn_rate, turn.course, turn.lateral_acceleration


def test_course_law(laws):
    """In wind of any strength, with errors of any size, standing still, without a command."""
    rng = np.random.default_rng(1)
    airspeed, gain = 1.7, 2.5
    controller = CourseController(PlanarVehicleParameters(airspeed, 2.0), gain)
    context = controller.CreateDefaultContext()
    ports = [
        controller.GetInputPort(name)
        for name in ("state", "velocity_command", "acceleration_feedforward")
    ]
    for k in range(COUNT):
        heading = 10 * rng.standard_normal()
        velocity, command, feedforward = 2 * rng.standard_normal((3, 2))
        velocity = velocity * (k % 7 > 0)
        command = command * (k % 11 > 0)
        state = [0, 0, 0, heading, *velocity, 0]
        inputs = (state, [*command, 0], [*feedforward, 0])
        for port, values in zip(ports, inputs, strict=True):
            port.FixValue(context, values)
        expected = [
            controller.GetOutputPort(name).Eval(context)[0]
            for name in ("turn_rate", "course", "lateral_acceleration")
        ]
        found = course(laws, heading, velocity, command, feedforward, airspeed, gain)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    for place in range(3):
        vectors = np.ones((3, 2))
        vectors[place, 1] = np.nan
        assert np.isnan(course(laws, 0.3, *vectors, airspeed, gain)).all()
    assert np.isnan(course(laws, np.nan, *np.ones((3, 2)), airspeed, gain)).all()
