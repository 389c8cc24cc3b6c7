"""Every vehicle in the loop: flights, mixed fleets, feasibility, and what is refused."""

import numpy as np
from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, ZeroOrderHold
import pytest

from sgvf_drake.exceptions import ConfigurationError
from systems import (
    DEFAULT_GAINS,
    DISTURBANCE_BANDWIDTH,
    VEHICLES,
    AddGuidance,
    Disturbance,
    FixedWing,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeMeshcat,
    MakeSimulator,
    Quadrotor,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
    SetPositions,
    SetVehicleState,
    Unicycle,
    VehicleNamed,
)

from .flying import LAP, ONE_RING, SPEED, UNIT, CircleField, check_refusal, rms

# What a vehicle keeps to on a ring: its radius in m, and the RMS over a lap in parts of it.
RINGS = {
    **dict.fromkeys(("quadrotor", "multibody", "unicycle"), (1.0, 0.004)),
    "fixed-wing": (100.0, 0.004),
}


def flown(field, vehicle, start, duration, air=None, **options):
    """The logged states (T, n) of a flight."""
    diagram = MakeFlightDiagram(field, vehicle, disturbance=air, **options)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetVehicleState(diagram, context, vehicle.StartState(np.array(start), field, air))
    SetNoiseSeed(diagram, context, 3)
    simulator.AdvanceTo(duration)
    return diagram.GetSubsystemByName("state_log").FindLog(context).data().T


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_flies_a_ring(flight_field, name):
    radius, tolerance = RINGS[name]
    kind = VehicleNamed(name)
    vehicle, field = kind.Make(kind.default_speed), flight_field.rescaled(radius)
    lap = LAP * radius / kind.default_speed
    states = flown(field, vehicle, (1.1 * radius, 0.0, 1.0), 1.3 * lap)
    assert states.shape[1] == len(vehicle.state_columns)
    last = states[-int(lap / 0.01) :]
    assert rms(np.hypot(*last[:, :2].T) - radius) < tolerance * radius
    speeds = np.linalg.norm(last[:, vehicle.velocity], axis=1)
    np.testing.assert_allclose(speeds, kind.default_speed, rtol=0.02)


@pytest.mark.parametrize("wind", [0.2, 0.6])
def test_a_fixed_wing_holds_its_line_in_wind(flight_field, wind):
    """As well as in still air, though it crabs by up to asin of wind over airspeed."""
    air = Disturbance(wind=(15.0 * wind, 0.0, 0.0))
    field, wing = flight_field.rescaled(100.0), FixedWing.Make(15.0)
    states = flown(field, wing, (105.0, 0.0, 50.0), 50.0, air)
    last = states[3000:]
    assert np.abs(np.hypot(*last[:, :2].T) - 100.0).max() < 1.0
    crab = last[:, 3] - np.arctan2(last[:, 5], last[:, 4])
    assert np.abs(np.sin(crab)).max() > 0.8 * wind
    np.testing.assert_array_equal(last[:, 2], 50.0)


def test_gusts_repeat_with_their_seed(flight_field):
    air = Disturbance(wind=(5.0, 0.0, 0.0), gust=1.0)
    flight = (flight_field.rescaled(100.0), FixedWing.Make(15.0), (105.0, 0.0, 50.0), 1.0, air)
    once = flown(*flight)
    np.testing.assert_array_equal(once, flown(*flight))
    assert np.ptp(np.linalg.norm(once[:, 4:6] - np.array([5.0, 0.0]), axis=1)) > 0.1


def test_a_unicycle_that_turns_at_once_moves_as_an_agent_does():
    """The agent is the paper's model: it moves along the field."""
    unicycle = Unicycle.Make(SPEED, 1e-4)
    states = flown(ONE_RING, unicycle, (1.4, 0.0, 0.0), 4.0)
    diagram = MakeKinematicDiagram(ONE_RING, speed=SPEED, log_period=0.01)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, [1.4, 0.0])
    simulator.AdvanceTo(4.0)
    positions = diagram.GetSubsystemByName("positions_log").FindLog(context).data().T
    assert np.linalg.norm(states[:, :2] - positions, axis=1).max() < 1e-3


def test_vehicles_of_two_kinds_move_as_each_does_alone():
    kinds = (Quadrotor(), Unicycle.Make(SPEED))
    starts = ((1.2, 0.0, 1.0), (-1.2, 0.1, 0.0))
    builder, logs = DiagramBuilder(), []
    for vehicle in kinds:
        plant = builder.AddNamedSystem(vehicle.name, vehicle.MakePlant())
        AddGuidance(builder, ONE_RING, plant, vehicle, name=f"{vehicle.name} loop")
        logs.append(LogVectorOutput(plant.GetOutputPort("state"), builder, 0.01))
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    for vehicle, start in zip(kinds, starts, strict=True):
        state = vehicle.StartState(np.array(start), ONE_RING)
        SetVehicleState(diagram, context, state, f"{vehicle.name} loop")
    simulator.AdvanceTo(1.0)
    for vehicle, start, log in zip(kinds, starts, logs, strict=True):
        alone = flown(ONE_RING, vehicle, start, 1.0)
        np.testing.assert_array_equal(log.FindLog(context).data().T, alone)


# Feasibility.


def turned_square(side, count=400):
    along = np.linspace(0.0, side, count, endpoint=False)
    line = np.column_stack([along, np.zeros(count)])
    corners = np.array([[0.0, 0.0], [side, 0.0], [side, side], [0.0, side]])
    turns = (np.array([[c, s], [-s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
    return np.concatenate(
        [corner + line @ turn for corner, turn in zip(corners, turns, strict=True)]
    )


class Along:
    """A field that leads along a line of points, and knows no Jacobian."""

    dim = 2

    def __init__(self, points):
        ahead = np.roll(points, -1, axis=0) - points
        self.m = ahead / np.linalg.norm(ahead, axis=1)[:, None]

    def value_and_jacobian(self, x):
        return self.m, np.zeros((len(x), 2, 2))


def test_the_curvature_of_a_ring_is_compared_with_that_of_the_tightest_turn():
    points = 1.0 * UNIT
    found = Unicycle.Make(0.5, 0.25).CheckFeasibility(ONE_RING, [points], 0.5)
    assert found.demand == pytest.approx(1.0)
    assert (found.limit, found.unit, found.is_feasible) == (4.0, "1/m", True)
    assert found.figures() == {"curvature_demand_1_m": found.demand, "curvature_limit_1_m": 4.0}
    # With the wind behind it turns wider over ground.
    air = Disturbance(wind=(3.0, 4.0, 0.0))
    found = FixedWing.Make(10.0, 0.9).CheckFeasibility(ONE_RING, [points], 10.0, air)
    assert found.limit == pytest.approx(1.0 / (0.9 * 1.5**2))
    assert not found.is_feasible


def test_corners_are_turned_wide_and_what_closes_up_is_refused():
    unicycle = Unicycle.Make(0.5, 1.0)
    wide, narrow = turned_square(6.0), turned_square(1.0)
    assert unicycle.CheckFeasibility(Along(wide), [wide], 0.5).is_feasible
    with pytest.raises(ConfigurationError, match="turns by 270 degrees within 3"):
        unicycle.CheckFeasibility(Along(narrow), [narrow], 0.5)
    with pytest.raises(ConfigurationError, match="a unicycle with a turn radius"):
        Unicycle.Make(0.5, 1.2).CheckFeasibility(ONE_RING, [1.0 * UNIT], 0.5)


# What is refused.


def refused(vehicle, field=ONE_RING, plant=None, **options):
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", plant or vehicle.MakePlant())
    try:
        AddGuidance(builder, field, plant, vehicle, **options)
    finally:
        assert builder.GetSystems() == [plant]


UNICYCLE, WING = Unicycle.Make(SPEED), FixedWing.Make(15.0)
ESTIMATES = DEFAULT_GAINS._replace(disturbance_bandwidth=DISTURBANCE_BANDWIDTH)


def planar_diagram():
    diagram = MakeFlightDiagram(ONE_RING, UNICYCLE)
    return diagram, diagram.CreateDefaultContext()


MISUSE = {
    "space": (lambda: refused(UNICYCLE, CircleField(3)), "needs a field of dimension 2, got 3"),
    "another speed": (lambda: refused(WING, speed=20.0), "one speed, 15 m/s, not 20"),
    "sensors": (lambda: refused(WING, sensors=SensorParameters()), "those of a quadrotor"),
    "gains twice": (lambda: refused(WING, gains=ESTIMATES), "belong to the vehicle given"),
    "no bandwidth": (lambda: Unicycle.Make(SPEED, gains=ESTIMATES), "has no gains to set"),
    "a quadrotor's plant": (
        lambda: refused(WING, plant=QuadrotorPlant()),
        "needs an input port 'turn_rate'; QuadrotorPlant has none",
    ),
    "a vehicle without its name": (
        lambda: refused(None, plant=UNICYCLE.MakePlant()),
        "needs an input port 'propeller_force'",
    ),
    "strong wind": (
        lambda: WING.MakePlant(Disturbance(wind=(9.0, 12.0, 0.0))),
        "wind of 15 m/s blows a fixed wing away that flies at 15 m/s",
    ),
    "lagging propellers": (
        lambda: WING.MakePlant(Disturbance(motor_lag=0.1)),
        "by wind and gusts only",
    ),
    "wind on the ground": (
        lambda: UNICYCLE.MakePlant(Disturbance()),
        "a unicycle stands on the ground: no wind moves it",
    ),
    "turns on the spot": (lambda: Quadrotor.Make(SPEED, 1.0), "no turn radius to choose"),
    "no radius": (lambda: Unicycle.Make(SPEED, 0.0), "turn_radius must be finite and positive"),
    "no speed": (lambda: FixedWing.Make(0.0), "speed must be finite and positive"),
    "hover": (lambda: SetHover(*planar_diagram(), [1.0, 0.0, 0.0]), "only a quadrotor hovers"),
    "a quadrotor's state": (
        lambda: SetVehicleState(*planar_diagram(), np.zeros(12)),
        r"state must have shape \(7,\), got \(12,\)",
    ),
    "unknown": (
        lambda: VehicleNamed("boat"),
        "no vehicle 'boat'; there are quadrotor, multibody, unicycle, fixed-wing",
    ),
    "Meshcat": (
        lambda: MakeFlightDiagram(ONE_RING, UNICYCLE, meshcat=MakeMeshcat(port=0)),
        "Meshcat shows quadrotors only, and no unicycle",
    ),
    "a state of another size": (
        lambda: refused(UNICYCLE, plant=with_ports("turn_rate", "state", 5)),
        "the state of a unicycle is x, y, z, heading, vx, vy, vz; that of 'plant' has 5",
    ),
}


def with_ports(actuation, state, size):
    builder = DiagramBuilder()
    hold = builder.AddSystem(ZeroOrderHold(0.1, size))
    builder.ExportInput(hold.get_input_port(), actuation)
    builder.ExportOutput(hold.get_output_port(), state)
    return builder.Build()


@pytest.mark.parametrize("what", MISUSE)
def test_misuse_is_told_in_one_line(what):
    check_refusal(*MISUSE[what])
