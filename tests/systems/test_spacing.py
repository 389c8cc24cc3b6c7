"""Vehicles that are spaced along one path: gaps, speeds, who counts, and what is refused."""

import math

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.metrics import least_separation
from sgvf_drake.paths import Piece
from systems import (
    AddGuidance,
    AddSpacing,
    Branch,
    MakeFlightDiagram,
    MakeSimulator,
    Pace,
    SetHover,
    SpacingController,
)
from systems.spacing import OFF_PATH

from .flying import LANES, LAP, ONE_RING, PARAMETERS, RINGS, SPEED, check_refusal

PACE = Pace(0.45, 0.3, 0.6)
# A power of two, so that updates and logs are at the same times.
PERIOD = 1.0 / 16.0
ANGLES = np.linspace(0.0, LAP, 800, endpoint=False)
# It crosses itself at the origin, a quarter and three quarters along.
EIGHT = np.column_stack([2.0 * np.cos(ANGLES), np.sin(2.0 * ANGLES)])


def branch_of(points):
    piece = Piece(points, closed=True)
    return Branch(piece.vertices, piece.length, True)


class Beads(LeafSystem):
    """Vehicles that are on a path, at exactly the speeds that they are given."""

    def __init__(self, branch, starts):
        super().__init__()
        self.line = Piece(branch.points, closed=True)
        self.DeclareContinuousState(BasicVector(starts))
        self.speeds = [self.DeclareVectorInputPort(f"speed_{i}", 1) for i in range(len(starts))]
        for i in range(len(starts)):
            self.DeclareVectorOutputPort(
                f"position_{i}",
                3,
                lambda context, output, i=i: output.SetFromVector(self.place(context, i)),
                {self.xc_ticket()},
            )

    def place(self, context, i):
        arc = context.get_continuous_state_vector().GetAtIndex(i) % self.line.length
        return np.append(self.line.at(np.array([arc]))[0], 1.0)

    def DoCalcTimeDerivatives(self, context, derivatives):  # noqa: N802
        derivatives.SetFromVector([port.Eval(context)[0] for port in self.speeds])


def string(branch, starts, duration, pace=PACE, **options):
    """Lets beads run from arc lengths; returns the gaps (T, n), speeds and positions."""
    n = len(starts)
    builder = DiagramBuilder()
    beads = builder.AddSystem(Beads(branch, starts))
    spacing = builder.AddSystem(SpacingController(branch, n, pace, period=PERIOD, **options))
    ports = [spacing.GetOutputPort("gaps")]
    for i in range(n):
        builder.Connect(beads.GetOutputPort(f"position_{i}"), spacing.get_input_port(i))
        builder.Connect(spacing.get_output_port(i), beads.get_input_port(i))
        ports.append(spacing.get_output_port(i))
    ports += [beads.get_output_port(i) for i in range(n)]
    logs = [LogVectorOutput(port, builder, PERIOD) for port in ports]
    simulator = MakeSimulator(builder.Build(), step=PERIOD)
    simulator.AdvanceTo(duration)
    # A log sees what held until its sample: at the first two, what was set at the start.
    data = [log.FindLog(simulator.get_context()).data().T[1:] for log in logs]
    return data[0], np.hstack(data[1 : n + 1]), np.stack(data[n + 1 :], axis=1)


@pytest.mark.parametrize("count", [2, 3, 8])
def test_gaps_become_equal_and_the_least_never_shrinks(count):
    starts = np.cumsum(np.random.default_rng(count).uniform(0.05, 0.5, count))
    gaps, speeds, positions = string(RINGS[0], starts, 60.0)
    length = Piece(RINGS[0].points, closed=True).length
    np.testing.assert_allclose(gaps.sum(axis=1), length)
    np.testing.assert_allclose(gaps[-1], length / count, rtol=0.02)
    assert (np.diff(gaps.min(axis=1)) > -1e-9).all()
    assert speeds.min() == PACE.slowest
    assert speeds.max() == PACE.fastest
    # The chord of the least gap there ever was, which is that at the start.
    assert least_separation(positions).min() >= 0.99 * 2.0 * math.sin(gaps[0].min() / 2.0)


@pytest.mark.parametrize("count", [2, 3, 8])
@pytest.mark.parametrize("mode", [1, 3])
def test_errors_die_out_as_the_laplacian_of_the_ring_says(count, mode):
    """Sampled, by the factor 1 - k T (2 - 2 cos(2 pi j / n)) in each period."""
    length = Piece(RINGS[0].points, closed=True).length
    index = np.arange(count)
    wave = 0.01 * np.cos(2.0 * math.pi * mode * index / count + 0.3)
    gaps, _, _ = string(RINGS[0], index * length / count + wave, 10.0)
    errors = gaps - length / count
    rate = 2.0 - 2.0 * math.cos(2.0 * math.pi * mode / count)
    factor = 1.0 - PACE.gain * PERIOD * rate
    expected = errors[0] * factor ** np.arange(len(errors))[:, None]
    np.testing.assert_allclose(errors, expected, atol=1e-9)


def test_equal_gaps_stay_as_they_are():
    length = Piece(RINGS[0].points, closed=True).length
    gaps, speeds, _ = string(RINGS[0], np.arange(5) * length / 5, 20.0)
    np.testing.assert_allclose(gaps, length / 5, rtol=1e-9)
    np.testing.assert_allclose(speeds, PACE.speed, rtol=1e-9)


def test_gaps_become_those_that_are_asked_for():
    shares = [3.0, 1.0, 2.0]
    gaps, _, _ = string(RINGS[0], [0.0, 2.0, 4.0], 40.0, shares=shares)
    np.testing.assert_allclose(gaps[-1], np.divide(shares, 6.0) * gaps[-1].sum(), rtol=0.01)
    stretched = gaps / shares
    assert (np.diff(stretched.min(axis=1)) > -1e-9).all()


def test_vehicles_keep_their_strand_where_the_path_crosses_itself():
    branch = branch_of(EIGHT)
    starts = np.array([0.1, 0.8, 1.9])
    gaps, _, positions = string(branch, starts, 60.0)
    length = Piece(branch.points, closed=True).length
    # No jumps: the gaps change by no more than what the speeds allow.
    assert np.abs(np.diff(gaps, axis=0)).max() <= 1.01 * PERIOD * (PACE.fastest - PACE.slowest)
    np.testing.assert_allclose(gaps[-1], length / 3, rtol=0.02)
    crossings = np.diff(np.sign(positions[..., 0]), axis=0) != 0
    assert (crossings.sum(axis=0) >= 4).all()


def track(branch, trace, **options):
    """Returns the arcs (T, n) of vehicles that are moved by hand, (T, n, 3)."""
    spacing = SpacingController(branch, trace.shape[1], PACE, period=PERIOD, **options)
    simulator = Simulator(spacing)
    context, arcs = simulator.get_mutable_context(), []
    for step, places in enumerate(trace):
        for i, place in enumerate(places):
            spacing.get_input_port(i).FixValue(context, place)
        # The update at this time is over then.
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        arcs.append(spacing.GetOutputPort("arcs").Eval(context).copy())
    return np.array(arcs), spacing, context


def at_angles(angles, radius=1.0):
    angles = np.asarray(angles)
    circle = [radius * np.cos(angles), radius * np.sin(angles), np.ones_like(angles)]
    return np.stack(np.broadcast_arrays(*circle), axis=-1)


def test_who_is_not_on_the_path_does_not_count():
    angles = np.add.outer(np.arange(30) * 0.02, [0.0, 2.0, 4.0])
    trace = at_angles(angles)
    trace[10:20, 1] *= [2.0, 2.0, 1.0]
    arcs, _, _ = track(RINGS[0], trace)
    assert (arcs[10:20, 1] == OFF_PATH).all()
    arcs[10:20, 1] = angles[10:20, 1]
    np.testing.assert_allclose(arcs, angles, atol=3e-3)
    _, spacing, context = track(RINGS[0], trace[:15])
    gaps = spacing.GetOutputPort("gaps").Eval(context)
    np.testing.assert_allclose(gaps[[0, 2]], [4.0, LAP - 4.0], atol=2e-3)
    assert gaps[1] == OFF_PATH
    speeds = [spacing.GetOutputPort(f"speed_{i}").Eval(context)[0] for i in range(3)]
    expected = PACE.gain * 2.0 * (4.0 - math.pi)
    clipped = np.clip([PACE.speed + expected, PACE.speed - expected], *PACE[1:3])
    np.testing.assert_allclose(speeds, [clipped[0], PACE.speed, clipped[1]])


def test_the_shares_of_who_is_on_the_path_are_enlarged():
    trace = at_angles([[0.0, 1.0, 2.3]])
    trace[:, 1, :2] *= 2.0
    _, spacing, context = track(RINGS[0], trace, shares=[1.0, 5.0, 2.0])
    # The others are to have a third and two thirds of the lap ahead.
    ahead, behind = 2.3 / (2 / 3), (LAP - 2.3) / (4 / 3)
    change = PACE.gain * (ahead - behind)
    speeds = [spacing.GetOutputPort(f"speed_{i}").Eval(context)[0] for i in range(3)]
    expected = [PACE.speed + change, PACE.speed, PACE.speed - change]
    np.testing.assert_allclose(speeds, expected, atol=2e-3)
    assert PACE.slowest < min(speeds) < max(speeds) < PACE.fastest


def test_a_corner_is_passed_between_long_sides():
    branch = branch_of(np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]))
    arcs = np.arange(1.8, 2.7, 0.03)
    places = np.column_stack([Piece(branch.points, closed=True).at(arcs), np.ones_like(arcs)])
    found, _, _ = track(branch, places[:, None].repeat(2, axis=1))
    np.testing.assert_allclose(found[:, 0], arcs, atol=1e-9)


def test_a_dead_end_is_left_again():
    """There and back on one line: the nearest places are two, one of each way."""
    x = np.concatenate([np.linspace(0.0, 3.0, 61), np.linspace(3.0, 0.0, 61)[1:-1]])
    branch = branch_of(np.column_stack([x, np.zeros_like(x)]))
    places = np.interp(np.arange(0.1, 5.9, 0.02), [0.0, 3.0, 6.0], [0.0, 3.0, 0.0])
    trace = np.column_stack([places, np.zeros_like(places), np.ones_like(places)])
    arcs, _, _ = track(branch, np.stack([trace, trace[::-1]], axis=1)[:, :1].repeat(2, axis=1))
    np.testing.assert_allclose(arcs[:, 0], np.arange(0.1, 5.9, 0.02), atol=0.1)


def test_nobody_on_the_path_is_no_error():
    arcs, spacing, context = track(RINGS[0], at_angles([[0.0, 1.0]], radius=3.0))
    assert (arcs == OFF_PATH).all()
    assert spacing.GetOutputPort("speed_1").Eval(context)[0] == PACE.speed


def test_a_position_that_is_not_finite_is_named():
    trace = at_angles([[0.0, 1.0]])
    trace[0, 1, 2] = np.nan
    with pytest.raises(NonFiniteValueError, match="the position of agent 1"):
        track(RINGS[0], trace)


def test_pace_and_shares_are_parameters():
    spacing = SpacingController(RINGS[0], 2, PACE, [1.0, 3.0])
    context = spacing.CreateDefaultContext()
    assert spacing.GetPace(context) == PACE
    np.testing.assert_allclose(spacing.GetShares(context), [0.25, 0.75])
    other = Pace.UpTo(1.0)
    assert other == (0.75, 0.5, 1.0, PACE.gain)
    spacing.SetPace(context, other)
    spacing.SetShares(context, [2.0, 2.0])
    assert spacing.GetPace(context) == other
    np.testing.assert_allclose(spacing.GetShares(context), 0.5)
    converted = spacing.ToScalarType[AutoDiffXd]()
    copy = converted.CreateDefaultContext()
    copy.SetTimeStateAndParametersFrom(context)
    assert converted.GetPace(copy) == other


def test_shares_written_into_the_context_are_checked_too():
    spacing = SpacingController(RINGS[0], 2, PACE)
    simulator = Simulator(spacing)
    context = simulator.get_mutable_context()
    for i, place in enumerate(at_angles([0.0, 1.0])):
        spacing.get_input_port(i).FixValue(context, place)
    context.get_mutable_numeric_parameter(spacing.shares_index).SetAtIndex(1, 0.0)
    with pytest.raises(ConfigurationError, match="need 2 shares"):
        simulator.Initialize()


class Squad:
    """Vehicles around the ring, with a loop each."""

    def __init__(self, count, speed=0.6):
        self.builder = DiagramBuilder()
        self.loops, self.logs = [], []
        for i in range(count):
            plant = self.builder.AddNamedSystem(f"vehicle {i}", PARAMETERS.MakePlant())
            loop = AddGuidance(self.builder, ONE_RING, plant, name=f"loop {i}", speed=speed)
            self.loops.append(loop)
            self.logs.append(LogVectorOutput(plant.GetOutputPort("state"), self.builder, 0.05))

    def space(self, **options):
        return AddSpacing(self.builder, options.pop("loops", self.loops), RINGS[0], **options)


def test_quadrotors_are_spaced_while_they_fly():
    squad = Squad(2)
    spacing = squad.space()
    log = LogVectorOutput(spacing.GetOutputPort("gaps"), squad.builder, 0.05)
    diagram = squad.builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    assert spacing.GetPace(spacing.GetMyContextFromRoot(context)) == Pace.UpTo(0.6)
    SetHover(diagram, context, [1.1, 0.0, 1.0], "loop 0")
    SetHover(diagram, context, [0.0, 1.0, 1.0], "loop 1")
    simulator.AdvanceTo(12.0)
    gaps = log.FindLog(context).data()
    np.testing.assert_allclose(gaps[:, -1], math.pi, rtol=0.02)
    states = np.stack([log.FindLog(context).data().T for log in squad.logs], axis=1)
    assert np.abs(np.hypot(*states[120:, :, :2].T) - 1.0).max() < 0.01
    assert least_separation(states[:, :, :3]).min() > 1.4


def test_the_speed_that_is_asked_for_is_flown_up_to_the_parameter():
    """A constant one as if it were the parameter, to the last bit."""
    states = []
    for speed, asked in ((SPEED, None), (2.0, SPEED), (SPEED, 2.0)):
        diagram = MakeFlightDiagram(ONE_RING, PARAMETERS, speed=speed)
        simulator = MakeSimulator(diagram)
        context = simulator.get_mutable_context()
        loop = diagram.GetSubsystemByName("guidance_loop")
        if asked is not None:
            own = loop.GetMyMutableContextFromRoot(context)
            loop.GetInputPort("speed").FixValue(own, [asked])
            told = loop.guidance.GetOutputPort("speed")
            assert told.Eval(loop.guidance.GetMyContextFromRoot(context))[0] == SPEED
        SetHover(diagram, context, [1.2, 0.0, 1.0])
        simulator.AdvanceTo(1.0)
        states.append(context.get_continuous_state_vector().CopyToVector())
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


@pytest.mark.parametrize(
    ("asked", "error"), [(-0.1, ConfigurationError), (np.nan, NonFiniteValueError)]
)
def test_a_speed_that_cannot_be_flown_is_refused(asked, error):
    diagram = MakeFlightDiagram(ONE_RING, PARAMETERS)
    context = diagram.CreateDefaultContext()
    loop = diagram.GetSubsystemByName("guidance_loop")
    SetHover(diagram, context, [1.2, 0.0, 1.0])
    loop.GetInputPort("speed").FixValue(loop.GetMyMutableContextFromRoot(context), [asked])
    with pytest.raises(error, match="speed"):
        loop.GetOutputPort("velocity_command").Eval(loop.GetMyContextFromRoot(context))


def twice():
    squad = Squad(2)
    squad.space()
    squad.space(name="other")


MISUSE = {
    "an open path": (lambda: SpacingController(LANES[0], 2, PACE), "closed path"),
    "one vehicle": (lambda: Squad(1).space(), "at least 2 vehicles, got 1"),
    "nobody": (lambda: Squad(2).space(loops=[], pace=PACE), "at least 2 vehicles, got 0"),
    "a share of zero": (lambda: Squad(2).space(shares=[1.0, 0.0]), "need 2 shares"),
    "a share too many": (lambda: Squad(2).space(shares=[1.0] * 3), "need 2 shares"),
    "speeds that do not differ": (
        lambda: SpacingController(RINGS[0], 2, Pace(0.4, 0.4, 0.5)),
        "slowest < speed < fastest",
    ),
    "no gain": (
        lambda: SpacingController(RINGS[0], 2, PACE._replace(gain=0.0)),
        "gain must be finite and positive",
    ),
    "a pace that guidance cannot fly": (
        lambda: Squad(2, speed=0.5).space(pace=PACE),
        "up to 0.6 m/s, but a guidance follows its field at 0.5 m/s",
    ),
    "vehicles that stand still": (lambda: Squad(2, speed=0.0).space(), "slowest guidance"),
    "a period that is too long": (
        lambda: Squad(2).space(period=1.0),
        "moves farther in a period of 1.0 s than the reach",
    ),
    "a reach of nothing": (lambda: Squad(2).space(reach=0.0), "reach must be"),
    "a name that is taken": (lambda: Squad(2).space(name="loop 0"), "'loop 0' already"),
    "a second spacing": (twice, "the speed of 'loop 0' is set already"),
    "a loop of another diagram": (
        lambda: Squad(2).space(loops=Squad(2).loops),
        "'loop 0' is not in the builder",
    ),
    "a vehicle that is given twice": (
        lambda: (squad := Squad(1)).space(loops=squad.loops * 2),
        "'loop 0' is given twice",
    ),
}


@pytest.mark.parametrize("what", MISUSE)
def test_misuse_is_told_in_one_line(what):
    check_refusal(*MISUSE[what])


def test_nothing_is_added_where_something_is_refused():
    squad = Squad(2)
    systems, wires = squad.builder.GetSystems(), len(squad.builder.connection_map())
    with pytest.raises(ConfigurationError):
        squad.space(pace=Pace.UpTo(5.0))
    assert squad.builder.GetSystems() == systems
    assert len(squad.builder.connection_map()) == wires
