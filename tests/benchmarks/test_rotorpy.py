"""The same circle flown by RotorPy and by this project, in one run.

RotorPy (Folk, Paulos and Kumar 2023) is a quadrotor simulator in Python with an SE(3)
controller that tracks a trajectory in time.  Both sides fly the same rigid body with the same
motors from the same hover, sampled at 100 Hz; what follows the path differs:

- RotorPy: its controller tracks its own circular trajectory, with its gains or with those of
  the attitude loop here;
- closed form: the control of this project alone, on a field that is known exactly;
- learned: the field of 200 unordered waypoints on the circle.

Without rotor dynamics on both sides: RotorPy lets its rotors follow with a time constant that
cannot be zero, so here they are set to what is commanded before each step and then held.
Drag is off.  RotorPy integrates with SciPy's RK45 at its default tolerance, Drake with
runge_kutta3 at 5 ms.  RotorPy's run has the sensors that it always simulates.
"""

import time

import numpy as np
import pytest
from rotorpy.controllers.quadrotor_control import SE3Control
from rotorpy.environments import Environment
from rotorpy.trajectories.circular_traj import ThreeDCircularTraj
from rotorpy.vehicles.multirotor import Multirotor
from scipy.spatial.transform import Rotation

import sgvf_drake as sgvf
from systems import (
    DEFAULT_GAINS,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)
from tests.systems.rotorpy_vehicle import THRUST_COEFFICIENT, rotorpy_parameters

from .measuring import Circle, best_of

pytestmark = pytest.mark.benchmark


RADIUS, ALTITUDE = 1.0, 1.0
SPEEDS = (0.45, 2.0)
SAMPLE_PERIOD = 0.01
LAPS = 3
START = np.array([RADIUS, 0.0, ALTITUDE])
PARAMETERS = QuadrotorParameters()
HOVER_SPEED = np.sqrt(PARAMETERS.hover_force / THRUST_COEFFICIENT)


class InstantRotors(Multirotor):
    """RotorPy's vehicle with rotors that are at once as fast as commanded."""

    def step(self, state, control, t_step):
        speeds = np.clip(
            self.get_cmd_motor_speeds(state, control),
            self.rotor_speed_min,
            self.rotor_speed_max,
        )
        return super().step({**state, "rotor_speeds": speeds}, control, t_step)


def make_rotorpy(speed, own_gains=True):
    parameters = rotorpy_parameters(DEFAULT_GAINS)
    if own_gains:
        del parameters["kp_att"], parameters["kd_att"]
    hover = {
        "x": START,
        "v": np.zeros(3),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, HOVER_SPEED),
    }
    frequency = speed / (2.0 * np.pi * RADIUS)
    return Environment(
        vehicle=InstantRotors(parameters, initial_state=hover, aero=False),
        controller=SE3Control(parameters),
        trajectory=ThreeDCircularTraj(
            center=np.array([0.0, 0.0, ALTITUDE]),
            radius=np.array([RADIUS, RADIUS, 0.0]),
            freq=np.array([frequency, frequency, 0.0]),
        ),
        sim_rate=1.0 / SAMPLE_PERIOD,
    )


def run_rotorpy(environment, duration):
    """As RotorPy's users run it; positions (n, 3) in m every 10 ms."""
    return environment.run(t_final=duration)["state"]["x"]


def run_drake(field, speed, duration):
    """As users of this project run it, with its logs; positions as those of RotorPy."""
    diagram = MakeFlightDiagram(field, speed=speed, altitude=ALTITUDE)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.AdvanceTo(duration)
    return diagram.GetSubsystemByName("state_log").FindLog(context).data()[:3].T


@pytest.fixture(scope="module")
def learned():
    """The field of 200 waypoints on the circle, in metres."""
    cloud, path = sgvf.make_shape("circle")
    scale = RADIUS / np.linalg.norm(path.pieces[0].vertices[0])
    return sgvf.train(sgvf.PointCloud(scale * cloud.points)).field


def cross_track_error(positions, speed):
    """Distance to the circle over the last lap."""
    lap = positions[-round(2.0 * np.pi * RADIUS / speed / SAMPLE_PERIOD) :]
    distance = np.hypot(np.hypot(lap[:, 0], lap[:, 1]) - RADIUS, lap[:, 2] - ALTITUDE)
    return {
        "cross_track_rms_m": float(np.sqrt(np.mean(distance**2))),
        "cross_track_max_m": float(distance.max()),
    }


def flights(learned, speed, duration):
    """What is compared, by name."""
    rotorpy = make_rotorpy(speed)
    same_attitude_gains = make_rotorpy(speed, own_gains=False)
    # As wide as a learned field is flown at 2 m/s.
    closed_form = Circle(gain=2.0)
    return {
        "RotorPy": lambda: run_rotorpy(rotorpy, duration),
        "RotorPy, our attitude gains": lambda: run_rotorpy(same_attitude_gains, duration),
        "closed-form field": lambda: run_drake(closed_form, speed, duration),
        "learned field": lambda: run_drake(learned, speed, duration),
    }


def test_both_fly_the_same_vehicle():
    vehicle = make_rotorpy(1.0).vehicle
    np.testing.assert_allclose(vehicle.f_to_TM, PARAMETERS.MixingMatrix(), atol=1e-15)
    plant = PARAMETERS.MakePlant()
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = np.concatenate((rng.normal(size=3), 0.3 * rng.normal(size=3), np.zeros(6)))
        forces = rng.uniform(0.5, 1.5, 4)
        context.SetContinuousState(state)
        plant.get_input_port().FixValue(context, forces)
        rates = plant.EvalTimeDerivatives(context).CopyToVector()
        rotation = Rotation.from_euler("xyz", state[3:6])
        speeds = np.sqrt(forces / THRUST_COEFFICIENT)
        found = vehicle.statedot(
            {
                "x": state[:3],
                "v": np.zeros(3),
                "q": rotation.as_quat(),
                "w": np.zeros(3),
                "wind": np.zeros(3),
                "rotor_speeds": speeds,
            },
            {"cmd_motor_speeds": speeds},
            SAMPLE_PERIOD,
        )
        np.testing.assert_allclose(found["vdot"], rates[6:9], atol=1e-12)
        # At rest, the body's angular acceleration is a linear map of that of roll-pitch-yaw.
        roll, pitch, _ = state[3:6]
        to_body = np.array(
            [
                [1.0, 0.0, -np.sin(pitch)],
                [0.0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
                [0.0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
            ]
        )
        np.testing.assert_allclose(found["wdot"], to_body @ rates[9:], atol=1e-10)


def test_closed_form_field_is_what_it_says():
    circle, step = Circle(2.0), 1e-6 * np.eye(2)
    for x in np.random.default_rng(0).uniform(-1.3, 1.3, (50, 2)):
        m, J = circle.value_and_jacobian(x)
        assert np.linalg.norm(m) == pytest.approx(1.0)
        differences = [(circle(x + h) - circle(x - h)) / 2e-6 for h in step]
        np.testing.assert_allclose(J, np.transpose(differences), atol=1e-7)


def test_circle_beside_rotorpy(save, learned):
    rows = []
    for speed in SPEEDS:
        duration = LAPS * 2.0 * np.pi * RADIUS / speed
        for name, run in flights(learned, speed, duration).items():
            repeats, seconds = best_of(run, clock=time.perf_counter)
            rows.append(
                {
                    "flown by": name,
                    "speed_m_s": speed,
                    **cross_track_error(repeats[0], speed),
                    "real_time_factor": duration / seconds,
                }
            )
    table = save(rows, "rotorpy")
    rms = table.pivot(index="flown by", columns="speed_m_s", values="cross_track_rms_m")
    # At an indoor pace everybody follows the circle to a centimetre ...
    assert (rms[0.45] < 0.01).all()
    # ... and at 2 m/s only those do that turn the desired attitude with the path.
    assert rms.loc["closed-form field", 2.0] < 0.01
    assert rms.loc["learned field", 2.0] < 0.02
    assert rms.loc["RotorPy", 2.0] > 0.1
