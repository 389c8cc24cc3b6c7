"""Several vehicles in one diagram, guidance of one's own, and what is refused."""

import numpy as np
from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, ZeroOrderHold
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import FourierCurve, ParametricField
from systems import (
    AddGuidance,
    BranchSupervisor,
    GuidanceLoop,
    IdealMotionCapture,
    MakeFlightDiagram,
    MakeSimulator,
    Se3Controller,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
)

from .flying import ONE_RING, PARAMETERS, RINGS, SPEED, TWO_RINGS, UNIT, check_refusal, rms

STARTS = ((1.25, 0.0, 1.0), (-1.9, 0.0, 1.2), (0.0, 1.2, 0.8), (0.0, -1.8, 1.0), (0.7, 0.7, 1))


class Fleet:
    """Vehicles named 1, 2.. around the rings, each with a loop of its own."""

    def __init__(self, options):
        builder = DiagramBuilder()
        self.logs, self.loops = [], []
        for number, own in enumerate(options, start=1):
            plant = builder.AddNamedSystem(f"vehicle {number}", PARAMETERS.MakePlant())
            loop = AddGuidance(builder, TWO_RINGS, plant, name=f"loop {number}", **own)
            self.loops.append(loop)
            self.logs.append(LogVectorOutput(plant.GetOutputPort("state"), builder, 0.01))
        self.diagram = builder.Build()

    def fly(self, starts, duration=3.0):
        simulator = MakeSimulator(self.diagram)
        context = simulator.get_mutable_context()
        for number, start in enumerate(starts, start=1):
            SetHover(self.diagram, context, start, f"loop {number}")
            SetNoiseSeed(self.diagram, context, number, f"loop {number}")
        simulator.AdvanceTo(duration)
        return [log.FindLog(context).data() for log in self.logs]


@pytest.mark.parametrize("sensors", [None, SensorParameters()])
@pytest.mark.parametrize("count", [2, 5])
def test_each_of_several_vehicles_flies_as_it_does_alone(count, sensors):
    """To the last bit, since all of them end the integrator's steps at the same times."""
    options = [{"speed": 0.3 + 0.1 * number, "sensors": sensors} for number in range(count)]
    together = Fleet(options).fly(STARTS[:count], 1.0)
    for number, (own, start, flight) in enumerate(
        zip(options, STARTS, together, strict=False), start=1
    ):
        diagram = MakeFlightDiagram(TWO_RINGS, PARAMETERS, **own)
        simulator = MakeSimulator(diagram)
        context = simulator.get_mutable_context()
        SetHover(diagram, context, start)
        SetNoiseSeed(diagram, context, number)
        simulator.AdvanceTo(1.0)
        alone = diagram.GetSubsystemByName("state_log").FindLog(context).data()
        np.testing.assert_array_equal(flight, alone)


def test_a_parameter_is_that_of_one_vehicle():
    fleet = Fleet([{"speed": SPEED}, {"speed": SPEED}])
    before = fleet.fly([STARTS[0], STARTS[0]])
    np.testing.assert_array_equal(*before)
    simulator = MakeSimulator(fleet.diagram)
    context = simulator.get_mutable_context()
    first = fleet.loops[0].guidance
    first.SetSpeed(first.GetMyMutableContextFromRoot(context), 2 * SPEED)
    speeds = [
        loop.guidance.GetSpeed(loop.guidance.GetMyContextFromRoot(context))
        for loop in fleet.loops
    ]
    assert speeds == [2 * SPEED, SPEED]


class Pursuit(LeafSystem):
    """Guidance of a user's own: to a point that goes around the circle."""

    def __init__(self):
        super().__init__()
        self.position = self.DeclareVectorInputPort("position", 3)
        self.DeclareVectorInputPort("velocity", 3)
        self.DeclareVectorOutputPort("velocity_command", 3, self.command)
        self.DeclareVectorOutputPort("acceleration_feedforward", 3, self.feedforward)

    def target(self, context):
        angle = SPEED * context.get_time()
        return np.array([np.cos(angle), np.sin(angle), 1.0])

    def command(self, context, output):
        x, y, _ = target = self.target(context)
        away = target - self.position.Eval(context)
        output.SetFromVector(SPEED * np.array([-y, x, 0.0]) + 2.0 * away)

    def feedforward(self, context, output):
        output.SetFromVector(-(SPEED**2) * self.target(context) * [1.0, 1.0, 0.0])


def test_any_system_of_these_ports_guides():
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("craft", QuadrotorPlant())
    AddGuidance(builder, Pursuit(), plant)
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, 0.1)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, [1.2, -0.2, 1.0])
    simulator.AdvanceTo(14.0)
    x, y, z = log.FindLog(context).data()[:3, 80:]
    assert rms(np.hypot(x, y) - 1.0) < 0.01
    assert rms(z - 1.0) < 0.001


def place(name="plant", plant=None):
    builder = DiagramBuilder()
    return builder, builder.AddNamedSystem(name, plant or PARAMETERS.MakePlant())


def twice(name):
    builder, plant = place()
    AddGuidance(builder, ONE_RING, plant)
    other = builder.AddNamedSystem("other", PARAMETERS.MakePlant())
    AddGuidance(builder, ONE_RING, plant if name == "second" else other, name=name)


def parametric():
    cloud = PointCloud(UNIT)
    return ParametricField(cloud, FourierCurve(cloud.normalize(cloud.points), closed=True))


def wrapped_plant():
    """A plant with the ports of a quadrotor that is none of Drake's class."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(PARAMETERS.MakePlant())
    builder.ExportInput(plant.get_input_port(), "propeller_force")
    builder.ExportOutput(plant.get_output_port(), "state")
    return builder.Build()


def in_order(placed, guidance=ONE_RING):
    builder, plant = placed
    return builder, guidance, plant


MISUSE = {
    "a name that is taken": (
        lambda: twice("guidance_loop"),
        r"a system 'guidance_loop' already: choose another `name`",
    ),
    "a second loop": (lambda: twice("second"), "'plant' is commanded already"),
    "a plant of another builder": (
        lambda: AddGuidance(DiagramBuilder(), ONE_RING, place()[1]),
        "'plant' is not in the builder",
    ),
    "a plant without propellers": (
        lambda: AddGuidance(*in_order(place(plant=ZeroOrderHold(0.1, 12)))),
        "needs an input port 'propeller_force'; ZeroOrderHold has none",
    ),
    "a plant of unknown parameters": (
        lambda: AddGuidance(*in_order(place(plant=wrapped_plant()))),
        "parameters must be given",
    ),
    "guidance without ports": (
        lambda: AddGuidance(*in_order(place(), ZeroOrderHold(0.1, 3))),
        "guidance needs an input port 'position'; ZeroOrderHold has none",
    ),
    "guidance that tells a supervisor no speed": (
        lambda: GuidanceLoop(
            Pursuit(),
            Se3Controller(),
            IdealMotionCapture(),
            BranchSupervisor(ONE_RING, RINGS[:1]),
        ),
        "guidance needs an output port 'speed'; Pursuit has none",
    ),
    "a jerk without a feed-forward": (
        lambda: AddGuidance(
            *in_order(place(), ONE_RING), feedforward=False, jerk_feedforward=True
        ),
        "adds to the feed-forward",
    ),
    "the jerk of a system that tells none": (
        lambda: AddGuidance(*in_order(place(), Pursuit()), jerk_feedforward=True),
        "guidance needs an output port 'command_derivatives'",
    ),
    "a parametric field": (
        lambda: AddGuidance(*in_order(place(), parametric())),
        "last coordinate is the parameter",
    ),
    "a start without a loop": (
        lambda: SetHover(wrapped_plant(), wrapped_plant().CreateDefaultContext(), STARTS[0]),
        "has no GuidanceLoop",
    ),
    "a start of none of several": (
        lambda: Fleet([{}, {}]).fly([STARTS[0]] * 3),
        "the loops loop 1, loop 2: none is 'loop 3'",
    ),
}


def test_with_its_derivatives_the_command_is_followed_ten_times_closer():
    """On a ring of 1 m at 2 m/s, held for 10 ms; without them the desired rates lag."""
    errors = []
    for told in (True, False):
        diagram = MakeFlightDiagram(ONE_RING, speed=2.0, jerk_feedforward=told, log_period=None)
        simulator = MakeSimulator(diagram)
        context = simulator.get_mutable_context()
        SetHover(diagram, context, STARTS[0])
        guidance = diagram.GetSubsystemByName("guidance_loop").guidance
        flown = guidance.GetFlownField(guidance.GetMyContextFromRoot(context))
        off = []
        for time in np.arange(2.5, 3.5, 0.1):
            simulator.AdvanceTo(time)
            state = diagram.GetOutputPort("state").Eval(context)
            off.append(np.linalg.norm(state[6:8] - 2.0 * flown(state[None, :2])[0]))
        errors.append(max(off))
    assert errors[0] < 0.1 * errors[1]


@pytest.mark.parametrize("what", MISUSE)
def test_misuse_is_told_in_one_line(what):
    check_refusal(*MISUSE[what])


def test_which_of_several_starts_has_to_be_said():
    fleet = Fleet([{}, {}])
    with pytest.raises(ConfigurationError, match="say which one"):
        SetHover(fleet.diagram, fleet.diagram.CreateDefaultContext(), STARTS[0])


def test_nothing_is_added_where_something_is_refused():
    builder, plant = place()
    with pytest.raises(ConfigurationError, match="speed"):
        AddGuidance(builder, ONE_RING, plant, speed=-1.0)
    assert builder.GetSystems() == [plant]
    assert not builder.connection_map()


def test_a_plant_of_another_class_flies_with_its_parameters():
    builder, plant = place("wrapped", wrapped_plant())
    AddGuidance(builder, ONE_RING, plant, PARAMETERS, speed=SPEED)
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, 0.01)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, STARTS[0])
    simulator.AdvanceTo(2.0)
    flight = log.FindLog(context).data()
    alone = MakeFlightDiagram(ONE_RING, PARAMETERS, speed=SPEED)
    other = MakeSimulator(alone)
    SetHover(alone, other.get_mutable_context(), STARTS[0])
    other.AdvanceTo(2.0)
    states = alone.GetSubsystemByName("state_log").FindLog(other.get_context()).data()
    np.testing.assert_array_equal(flight, states)
