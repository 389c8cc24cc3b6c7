"""Flights of Drake's quadrotor from branch to branch, and what a supervisor does in need."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    DiscreteTimeDelay,
    LogVectorOutput,
    MatrixGain,
    RandomSource,
)
import pytest
import sympy

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    GuidanceSystem,
    MakeSimulator,
    QuadrotorParameters,
    Se3Controller,
    SetHover,
    branch_supervisor,
    supervision,
)
from systems.branch_supervisor import DEFAULT_HOLD_AFTER, BranchSupervisor
from systems.branches import Branch
from systems.sensing import AddMotionCapture
from systems.supervision import LANDING_RATE
from systems.supervisor_memory import (
    HOLD_POSITION,
    MAX_CORRECTION,
    ON_TOUR,
    POSITION_GAIN,
    CalcCommands,
    Memory,
    Mode,
)

SPEED = 0.45
ANGLES = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
UNIT = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
PARAMETERS = QuadrotorParameters()


class TwoRings:
    """A field of unit length around rings of 1 and 2 m, counter-clockwise, in closed form.

    In three dimensions the rings lie at heights of 1 and 2 m.
    """

    def __init__(self, dim):
        self.dim = dim
        p = sympy.symbols("x y z")[:dim]
        x, y = p[0], p[1]
        r = sympy.sqrt(x**2 + y**2)
        pull = -6 * (r - 1) * (r - sympy.Rational(3, 2)) * (r - 2)
        direction = [(-y + pull * x) / r, (x + pull * y) / r]
        if dim == 3:
            direction.append(3 * (r - p[2]))
        length = sympy.sqrt(sum(c**2 for c in direction))
        m = [c / length for c in direction]
        J = [[sympy.diff(c, s) for s in p] for c in m]
        self._evaluate = sympy.lambdify(p, [m, J], "math", cse=True)

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        pairs = [self._evaluate(*row) for row in np.atleast_2d(x).tolist()]
        m, J = (np.array(values) for values in zip(*pairs, strict=True))
        return m.reshape(x.shape), J.reshape(*x.shape, self.dim)

    def hessian(self, x):
        raise NotImplementedError("nothing here is differentiated twice")


class TwoLanes:
    """Leads along y = 0 to rest at x = 3, and back along y = 2 to rest at x = 0."""

    dim = 2

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        points = np.atleast_2d(x)
        back = points[:, 1] > 1.0
        along = np.tanh((np.where(back, 0.0, 3.0) - points[:, 0]) / 0.3)
        across = np.tanh((np.where(back, 2.0, 0.0) - points[:, 1]) / 0.3)
        J = np.zeros((len(points), 2, 2))
        J[:, 0, 0], J[:, 1, 1] = -(1 - along**2) / 0.3, -(1 - across**2) / 0.3
        return np.column_stack([along, across]).reshape(x.shape), J.reshape(*x.shape, 2)


def ring(radius, dim=2):
    points = radius * UNIT
    if dim == 3:
        points = np.column_stack([points, np.full(len(points), radius)])
    return Branch(points, 2 * math.pi * radius, True)


@pytest.fixture(scope="module")
def rings_field():
    return TwoRings(2)


RINGS = (ring(1.0), ring(2.0))
BOX = ([-2.5, -2.5], [2.5, 2.5])


class Flight:
    """A supervised vehicle with its logs; the age of the measurement is an input."""

    def __init__(self, field, branches=RINGS, start=(1.02, 0.0, 1.0), **arguments):
        speed, noisy = arguments.pop("speed", SPEED), arguments.pop("noisy", False)
        builder = DiagramBuilder()
        plant = builder.AddNamedSystem("plant", PARAMETERS.MakePlant())
        measured = AddMotionCapture(builder, plant.GetOutputPort("state"))
        port = measured.get_output_port()
        if noisy:
            port = add_noise_and_delay(builder, port)
        guidance = builder.AddSystem(GuidanceSystem(field, speed, 1.0))
        controller = builder.AddSystem(Se3Controller(PARAMETERS))
        self.supervisor = builder.AddNamedSystem(
            "supervisor", BranchSupervisor(field, branches, **arguments)
        )
        for system in (guidance, controller, self.supervisor):
            builder.Connect(port, system.GetInputPort("state"))
        for name in ("velocity_command", "acceleration_feedforward"):
            builder.Connect(guidance.GetOutputPort(name), self.supervisor.GetInputPort(name))
            builder.Connect(self.supervisor.GetOutputPort(name), controller.GetInputPort(name))
        builder.Connect(guidance.GetOutputPort("speed"), self.supervisor.GetInputPort("speed"))
        builder.Connect(
            controller.GetOutputPort("propeller_force"), plant.GetInputPort("propeller_force")
        )
        builder.ExportInput(self.supervisor.GetInputPort("measurement_age"), "age")
        ports = {
            "state": plant.GetOutputPort("state"),
            "command": self.supervisor.GetOutputPort("velocity_command"),
            "force": controller.GetOutputPort("propeller_force"),
            "mode": self.supervisor.GetOutputPort("mode"),
            "branch": self.supervisor.GetOutputPort("branch"),
        }
        logs = {name: LogVectorOutput(port, builder, 0.01) for name, port in ports.items()}
        self.diagram = builder.Build()
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.set_age(0.0)
        SetHover(self.diagram, self.context, start)
        if noisy:
            delay = self.diagram.GetSubsystemByName("delay")
            seen = delay.GetMyMutableContextFromRoot(
                self.context
            ).get_mutable_discrete_state_vector()
            seen.SetFromVector(np.resize([*start, *np.zeros(9)], seen.size()))
        self._logs = logs

    @property
    def supervisor_context(self):
        return self.supervisor.GetMyMutableContextFromRoot(self.context)

    def set_age(self, age):
        self.diagram.GetInputPort("age").FixValue(self.context, [age])

    def want(self, branch):
        self.supervisor.SetBranch(self.supervisor_context, branch)

    def advance(self, duration):
        self.simulator.AdvanceTo(self.context.get_time() + duration)

    def log(self, name):
        values = self._logs[name].FindLog(self.context).data().T
        return values[:, 0] if values.shape[1] == 1 else values

    def history(self):
        """The modes with their branches, in the order in which they were."""
        pairs = zip(self.log("mode").tolist(), self.log("branch").tolist(), strict=True)
        history = []
        for pair in pairs:
            if not history or history[-1] != pair:
                history.append(pair)
        return [(Mode(int(mode)).name, int(branch)) for mode, branch in history]

    @property
    def memory(self):
        vector = self.supervisor_context.get_discrete_state(0).CopyToVector()
        return Memory.FromVector(vector)

    @property
    def mode(self):
        return Mode(int(self.supervisor.GetOutputPort("mode").Eval(self.supervisor_context)[0]))

    @property
    def state(self):
        plant = self.diagram.GetSubsystemByName("plant")
        return plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(self.context))

    def radius_errors(self, branch, radius):
        """Distances to a ring while it is followed."""
        here = (self.log("mode") == Mode.FOLLOW) & (self.log("branch") == branch)
        return np.hypot(*self.log("state")[here, :2].T) - radius


def add_noise_and_delay(builder, port):
    """Adds 1 mm, 0.1 degrees, 1 cm/s, 1 degree/s and 20 ms to what is measured."""
    deviations = np.repeat([1e-3, math.radians(0.1), 1e-2, math.radians(1.0)], 3)
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 12, 0.01))
    gain = builder.AddSystem(MatrixGain(np.diag(deviations)))
    adder = builder.AddSystem(Adder(2, 12))
    delay = builder.AddNamedSystem("delay", DiscreteTimeDelay(0.01, 2, 12))
    builder.Connect(source.get_output_port(), gain.get_input_port())
    builder.Connect(port, adder.get_input_port(0))
    builder.Connect(gain.get_output_port(), adder.get_input_port(1))
    builder.Connect(adder.get_output_port(), delay.get_input_port())
    return delay.get_output_port()


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("noisy", [False, True])
def test_tour_of_two_rings(rings_field, noisy):
    flight = Flight(rings_field, tour=(0, 1, 0), laps=0.3, noisy=noisy)
    flight.advance(34.0)
    rings = [("FOLLOW", 0), ("TRANSFER", 1), ("FOLLOW", 1), ("TRANSFER", 0), ("FOLLOW", 0)]
    assert flight.history() == rings
    flying = np.arange(len(flight.log("mode"))) > 150
    speeds = np.linalg.norm(flight.log("state")[flying, 6:8], axis=1)
    assert speeds.min() > 0.55 * SPEED, "the vehicle must not stop"
    assert speeds.max() < 1.35 * SPEED
    for branch, radius in enumerate((1.0, 2.0)):
        errors = flight.radius_errors(branch, radius)[200:]
        assert rms(errors) < 0.015
    forces = flight.log("force")[flying]
    assert np.abs(forces - PARAMETERS.hover_force).max() < 0.1
    steps = np.linalg.norm(np.diff(flight.log("command")[flying], axis=0), axis=1)
    assert steps.max() < (0.04 if noisy else 0.012)
    assert np.abs(flight.log("state")[flying, 2] - 1.0).max() < 0.01


@pytest.mark.parametrize(
    ("tour", "laps", "expected"),
    [((0, 1), 1.25, {0: 1.25}), ((0, 0, 1), 0.4, {0: 0.8}), ((0, 1, 0), 0.3, {0: 0.3, 1: 0.3})],
)
def test_laps_are_flown_before_the_next_branch(rings_field, tour, laps, expected):
    flight = Flight(rings_field, tour=tour, laps=laps)
    flight.advance(22.0)
    mode, branch = flight.log("mode"), flight.log("branch")
    leaving = np.flatnonzero((mode[:-1] == Mode.FOLLOW) & (mode[1:] == Mode.TRANSFER))
    for end, (number, flown) in zip(leaving, expected.items(), strict=True):
        here = np.flatnonzero((mode[:end] == Mode.FOLLOW) & (branch[:end] == number))
        angle = np.unwrap(np.arctan2(*flight.log("state")[here, 1::-1].T))
        # Waiting for a place to depart from takes at most a little, see test_branches.
        assert flown - 0.02 < (angle[-1] - angle[0]) / (2 * math.pi) < flown + 0.1


def test_departure_waits_as_planned(rings_field, monkeypatch):
    monkeypatch.setattr(supervision, "DepartureDelay", lambda *_: 0.5)
    flight = Flight(rings_field)
    flight.advance(1.0)
    flight.want(1)
    flight.advance(0.495)
    assert flight.mode == Mode.FOLLOW
    flight.advance(0.02)
    assert flight.mode == Mode.TRANSFER


def test_hand_over_is_smooth_where_the_vehicle_lags(rings_field):
    flight = Flight(rings_field, tour=(0, 1), laps=0.5, speed=2.0)
    flight.advance(5.0)
    mode, command = flight.log("mode"), flight.log("command")
    end = np.flatnonzero((mode[:-1] == Mode.TRANSFER) & (mode[1:] == Mode.FOLLOW))[0]
    steps = np.linalg.norm(np.diff(command[end - 50 : end + 50], axis=0), axis=1)
    # The command turns by 2 to 4 m/s^2, 0.02 to 0.04 m/s a sample.
    assert steps.max() < 0.06


def test_wanted_branch_is_flown_to_and_the_tour_goes_on_after_it(rings_field):
    flight = Flight(rings_field, tour=(0,))
    flight.advance(2.0)
    flight.want(1)
    flight.advance(8.0)
    assert flight.mode == Mode.FOLLOW
    assert np.hypot(*flight.state[:2]) == pytest.approx(2.0, abs=0.02)
    flight.want(ON_TOUR)
    flight.advance(8.0)
    assert np.hypot(*flight.state[:2]) == pytest.approx(1.0, abs=0.02)
    assert [branch for _, branch in flight.history()] == [0, 1, 1, 0, 0]


def test_wanted_branch_may_change_in_a_transfer(rings_field):
    flight = Flight(rings_field)
    flight.advance(2.0)
    flight.want(1)
    flight.advance(2.0)
    assert flight.mode == Mode.TRANSFER
    assert flight.memory.flown == 0.0
    flight.want(0)
    flight.advance(13.0)
    assert flight.history() == [("FOLLOW", 0), ("TRANSFER", 1), ("TRANSFER", 0), ("FOLLOW", 0)]
    speeds = np.linalg.norm(flight.log("state")[150:, 6:8], axis=1)
    assert speeds.min() > 0.5 * SPEED


def test_position_is_held_on_command_and_the_branch_taken_up_again(rings_field):
    flight = Flight(rings_field)
    flight.advance(3.0)
    flight.want(HOLD_POSITION)
    flight.advance(4.0)
    assert flight.mode == Mode.HOLD
    held = flight.state[:3].copy()
    flight.advance(2.0)
    np.testing.assert_allclose(flight.state[:3], held, atol=2e-3)
    assert np.abs(flight.state[6:9]).max() < 2e-3
    flight.want(0)
    flight.advance(6.0)
    assert flight.mode == Mode.FOLLOW
    assert np.hypot(*flight.state[:2]) == pytest.approx(1.0, abs=0.01)
    # Neither the stop nor the start makes a step of the command.
    steps = np.linalg.norm(np.diff(flight.log("command")[150:], axis=0), axis=1)
    assert steps.max() < 0.012


def test_lost_measurement_stops_the_vehicle_until_it_is_back(rings_field):
    flight = Flight(rings_field)
    flight.advance(3.0)
    flight.set_age(DEFAULT_HOLD_AFTER)
    flight.advance(0.5)
    assert flight.mode == Mode.FOLLOW
    flight.set_age(DEFAULT_HOLD_AFTER + 0.01)
    flight.advance(3.0)
    assert flight.mode == Mode.HOLD
    assert np.linalg.norm(flight.state[6:9]) < 0.01
    # Hardly better is not back: no chatter at the threshold.
    flight.set_age(DEFAULT_HOLD_AFTER - 0.01)
    flight.advance(1.0)
    assert flight.mode == Mode.HOLD
    flight.set_age(0.0)
    flight.advance(5.0)
    assert flight.history() == [("FOLLOW", 0), ("HOLD", 0), ("TRANSFER", 0), ("FOLLOW", 0)]
    assert np.hypot(*flight.state[:2]) == pytest.approx(1.0, abs=0.01)


def test_measurement_lost_for_long_lands_the_vehicle_for_good(rings_field):
    flight = Flight(rings_field, landing_height=0.1)
    flight.advance(3.0)
    flight.set_age(1.01)
    flight.advance(2.0)
    descent = flight.log("state")[-1, 8]
    assert descent == pytest.approx(-LANDING_RATE, rel=0.1)
    flight.advance(10.0)
    down = flight.state.copy()
    assert down[2] == pytest.approx(0.1, abs=2e-3)
    flight.set_age(0.0)
    flight.want(1)
    flight.advance(2.0)
    assert flight.mode == Mode.LAND
    np.testing.assert_allclose(flight.state[:3], down[:3], atol=2e-3)
    command = flight.supervisor.GetOutputPort("velocity_command").Eval(
        flight.supervisor_context
    )
    assert np.abs(command).max() < 2e-3
    assert flight.log("state")[:, 2].min() > 0.09
    assert np.abs(flight.log("force")[150:] - PARAMETERS.hover_force).max() < 0.15


@pytest.mark.parametrize("speed", [4.5, 12.0])
def test_vehicle_slows_down_to_what_the_thrust_allows(circle_field, speed):
    flight = Flight(circle_field, (RINGS[0],), (1.2, 0.0, 1.0), speed=speed)
    flight.advance(6.0)
    state = flight.log("state")[400:]
    speeds = np.linalg.norm(state[:, 6:8], axis=1)
    # Two fifths of the greatest horizontal acceleration, on a circle of 1 m.
    expected = math.sqrt(0.4 * PARAMETERS.max_horizontal_acceleration)
    np.testing.assert_allclose(speeds, expected, rtol=0.02)
    assert rms(np.hypot(*state[:, :2].T) - 1.0) < 0.005
    assert np.abs(state[:, 2] - 1.0).max() < 0.02
    force = flight.log("force")[400:]
    assert 0.0 < force.min() < force.max() < 0.8 * PARAMETERS.max_propeller_force


def test_slow_flight_is_not_slowed_down(rings_field):
    flight = Flight(rings_field)
    flight.advance(3.0)
    assert np.linalg.norm(flight.state[6:8]) == pytest.approx(SPEED, rel=0.01)


def test_start_outside_of_the_box_flies_in(rings_field):
    flight = Flight(rings_field, tour=(1,), start=(3.0, -3.5, 1.0), box=BOX)
    flight.advance(12.0)
    assert flight.history()[-2:] == [("TRANSFER", 1), ("FOLLOW", 1)]
    assert np.hypot(*flight.state[:2]) == pytest.approx(2.0, abs=0.02)
    assert flight.log("mode")[1] == Mode.TRANSFER


def test_start_beside_another_branch_flies_to_the_wanted_one(rings_field):
    flight = Flight(rings_field, tour=(0,), start=(0.0, 2.1, 1.0))
    flight.advance(8.0)
    assert flight.history()[-2:] == [("TRANSFER", 0), ("FOLLOW", 0)]
    assert np.hypot(*flight.state[:2]) == pytest.approx(1.0, abs=0.02)


def test_start_beside_the_wanted_branch_needs_no_transfer(rings_field):
    flight = Flight(rings_field, tour=(0,), start=(0.0, 2.1, 1.0))
    flight.want(1)
    flight.advance(1.0)
    assert flight.history()[-1] == ("FOLLOW", 1)
    assert "TRANSFER" not in {mode for mode, _ in flight.history()}


def test_spatial_field():
    field = TwoRings(3)
    flight = Flight(
        field, (ring(1.0, 3), ring(2.0, 3)), tour=(0, 1), laps=0.2, landing_height=0.5
    )
    flight.advance(14.0)
    assert flight.history() == [("FOLLOW", 0), ("TRANSFER", 1), ("FOLLOW", 1)]
    errors = [np.hypot(*flight.state[:2]) - 2.0, flight.state[2] - 2.0]
    np.testing.assert_allclose(errors, 0.0, atol=0.015)
    speeds = np.linalg.norm(flight.log("state")[150:, 6:9], axis=1)
    assert speeds.min() > 0.55 * SPEED
    flight.set_age(2.0)
    flight.advance(14.0)
    assert flight.mode == Mode.LAND
    assert flight.state[2] == pytest.approx(0.5, abs=2e-3)
    assert np.linalg.norm(flight.state[6:9]) < 2e-3


LANE_X = np.linspace(0.0, 3.0, 31)
LANES = (
    Branch(np.column_stack([LANE_X, np.zeros(31)]), 3.0, False),
    Branch(np.column_stack([LANE_X[::-1], np.full(31, 2.0)]), 3.0, False),
)


# From the start it is the length that counts, from the middle the rest.
@pytest.mark.parametrize("start", [-0.2, 1.5])
def test_open_branches_end_where_the_field_rests(start):
    flight = Flight(TwoLanes(), LANES, (start, 0.0, 1.0), tour=(0, 1), laps=5.0)
    flight.advance(30.0)
    assert flight.history() == [("FOLLOW", 0), ("TRANSFER", 1), ("FOLLOW", 1)]
    np.testing.assert_allclose(flight.state[:2], [0.0, 2.0], atol=0.02)


def entry_after_a_stop(wanted):
    """Where a vehicle enters a lane that has stopped in the middle of the first one."""
    flight = Flight(TwoLanes(), LANES, (0.5, 0.0, 1.0))
    flight.advance(3.0)
    flight.want(HOLD_POSITION)
    flight.advance(2.0)
    flight.want(wanted)
    flight.advance(0.05)
    return flight.memory.control_points[-1]


def test_open_branch_is_entered_at_its_start_but_taken_up_again_where_it_was_left():
    np.testing.assert_allclose(entry_after_a_stop(1), [2.85, 2.0], atol=0.16)
    x, y = entry_after_a_stop(0)
    assert 1.5 < x < 2.7
    assert y == 0.0


def test_vehicle_that_is_told_to_stand_does_not_depart(rings_field):
    flight = Flight(rings_field, speed=0.0)
    flight.want(1)
    flight.advance(1.0)
    assert flight.mode == Mode.FOLLOW
    assert np.abs(flight.state[6:9]).max() < 1e-6


def test_commands_are_evaluated_once_in_a_sample(circle_field, monkeypatch):
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return CalcCommands(*arguments)

    monkeypatch.setattr(branch_supervisor, "CalcCommands", counted)
    flight = Flight(circle_field, (RINGS[0],))
    flight.advance(1.0)
    fields, commands = circle_field.calls, len(calls)
    flight.advance(2.0)
    # Anything that depends on the time would run in every stage of the integrator.
    assert circle_field.calls - fields == 200
    assert len(calls) - commands <= 401


def test_clone_in_a_transfer_flies_on_alike(rings_field):
    flight = Flight(rings_field)
    flight.advance(1.0)
    flight.want(1)
    flight.advance(2.5)
    assert flight.mode == Mode.TRANSFER
    twin = MakeSimulator(flight.diagram, flight.context.Clone())
    twin.AdvanceTo(8.0)
    flight.advance(4.5)
    np.testing.assert_array_equal(
        twin.get_context().get_continuous_state_vector().CopyToVector(),
        flight.context.get_continuous_state_vector().CopyToVector(),
    )


def test_default_context_starts_anew(rings_field):
    flight = Flight(rings_field, tour=(0, 1), laps=0.2)
    flight.advance(6.0)
    first = flight.log("state").copy()
    flight.diagram.SetDefaultContext(flight.context)
    flight.set_age(0.0)
    flight.context.SetTime(0.0)
    SetHover(flight.diagram, flight.context, (1.02, 0.0, 1.0))
    flight._logs["state"].FindMutableLog(flight.context).Clear()
    flight.simulator.Initialize()
    flight.advance(6.0)
    np.testing.assert_array_equal(flight.log("state")[-600:], first[-600:])


INPUTS = {
    "state": np.concatenate(([1.1, 0.3, 1.2], np.full(3, 0.05), [0.2, 0.3, -0.1], np.zeros(3))),
    "velocity_command": np.array([0.3, -0.1, 0.2]),
    "acceleration_feedforward": np.array([0.2, 0.4, -0.1]),
    "speed": np.array([SPEED]),
    "measurement_age": np.array([0.0]),
}


def fix_inputs(system, context, **changed):
    for name, value in {**INPUTS, **changed}.items():
        system.GetInputPort(name).FixValue(context, value)


def sample(system, context):
    """Lets the supervisor see its inputs once."""
    context.SetDiscreteState(0, system.EvalUniquePeriodicDiscreteUpdate(context).value(0))


def commands(system, context):
    names = ("velocity_command", "acceleration_feedforward")
    return np.concatenate([system.GetOutputPort(name).Eval(context) for name in names])


def test_guidance_passes_unchanged_before_anything_is_seen(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    fix_inputs(system, context)
    expected = [INPUTS["velocity_command"], INPUTS["acceleration_feedforward"]]
    np.testing.assert_array_equal(commands(system, context), np.concatenate(expected))


def see(system, context):
    """The memory after one sample."""
    sample(system, context)
    return Memory.FromVector(context.get_discrete_state(0).CopyToVector())


def moving(velocity, radius=1.0):
    """A vehicle on the x axis."""
    return np.array([radius, 0.0, 1.0, 0.0, 0.0, 0.0, *velocity, 0.0, 0.0, 0.0])


def test_stop_begins_with_the_command_unless_the_vehicle_moves_otherwise(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    command = SPEED * np.array([0.0, 1.0, 0.0])
    for velocity, expected in (
        ([0.02, SPEED - 0.03, 0.0], command[:2]),
        ([0.4, 0.1, 0.0], [0.4, 0.1]),
    ):
        context = system.CreateDefaultContext()
        fix_inputs(system, context, state=moving(velocity), velocity_command=command)
        sample(system, context)
        system.SetBranch(context, HOLD_POSITION)
        memory = see(system, context)
        assert memory.mode == Mode.HOLD
        assert memory.scale_rate == 0.0
        if velocity[0] < 0.1:
            # The speed has only begun to rise to the command.
            expected = expected * memory.scale
        np.testing.assert_allclose(memory.velocity[:2], expected, atol=1e-12)


def test_landing_begins_with_the_climb_rate_that_is_commanded():
    system = BranchSupervisor(TwoRings(3), (ring(1.0, 3),))
    command = SPEED * np.array([0.0, 0.8, 0.6])
    context = system.CreateDefaultContext()
    fix_inputs(system, context, state=moving(command), velocity_command=command)
    sample(system, context)
    system.GetInputPort("measurement_age").FixValue(context, [9.0])
    memory = see(system, context)
    assert memory.mode == Mode.LAND
    # It begins to descend with 0.5 m/s^2.
    assert memory.velocity[2] == pytest.approx(0.6 * SPEED - 0.005)


def test_speed_moves_as_the_thrust_allows(circle_field):
    system = BranchSupervisor(circle_field, RINGS[:1])
    limit = 0.4 * PARAMETERS.max_horizontal_acceleration
    for velocity, rate in (
        ([0.0, 0.0, 0.0], 0.1 * limit / 12),
        ([0.0, 12.0, 0.0], -limit / 12),
    ):
        context = system.CreateDefaultContext()
        fix_inputs(system, context, state=moving(velocity), speed=np.array([12.0]))
        memory = see(system, context)
        assert memory.scale_rate == pytest.approx(rate, rel=1e-9)


def test_transfer_is_flown_at_a_speed_that_its_branch_allows(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    limit = 0.4 * PARAMETERS.max_horizontal_acceleration
    for branch, radius in enumerate((1.0, 2.0)):
        context = system.CreateDefaultContext()
        system.SetBranch(context, branch)
        far = moving(np.zeros(3), 2.0 if branch == 0 else 1.0)
        fix_inputs(system, context, state=far, speed=np.array([12.0]))
        memory = see(system, context)
        assert memory.mode == Mode.TRANSFER
        assert 12.0 * memory.scale == pytest.approx(math.sqrt(limit * radius), rel=1e-6)


def test_distance_is_counted_on_the_branch_only(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    command = SPEED * np.array([0.0, 1.0, 0.0])
    for radius, flown in ((1.1, 0.4 * 0.01), (0.5, 0.0)):
        context = system.CreateDefaultContext()
        state = moving([0.3, 0.4, 0.1], radius)
        fix_inputs(system, context, state=state, velocity_command=command)
        assert see(system, context).flown == pytest.approx(flown, abs=1e-12)


def test_reference_is_corrected_in_proportion_and_not_without_limit(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    system.SetBranch(context, HOLD_POSITION)
    fix_inputs(system, context, state=moving([0.0, 0.4, 0.0]))
    memory = see(system, context)
    off = moving([0.1, 0.2, 0.0])
    off[:2] = memory.position[:2] + np.array([1e-5, -2e-5])
    fix_inputs(system, context, state=off)
    v_ref, a_ref = memory.velocity[:2], memory.acceleration[:2]
    output = commands(system, context)
    np.testing.assert_allclose(output[:2], v_ref + POSITION_GAIN * np.array([-1e-5, 2e-5]))
    np.testing.assert_allclose(
        output[3:5], a_ref + POSITION_GAIN * (v_ref - [0.1, 0.2]), rtol=1e-6
    )
    assert output[2] == INPUTS["velocity_command"][2]
    off[:2] = memory.position[:2] + np.array([300.0, 400.0])
    fix_inputs(system, context, state=off)
    correction = commands(system, context)[:2] - v_ref
    np.testing.assert_allclose(
        correction, [-0.6 * MAX_CORRECTION, -0.8 * MAX_CORRECTION], rtol=1e-4
    )


@pytest.mark.parametrize("age", [0.0, 0.5, 2.0])
def test_gradients_agree_with_differences(rings_field, age):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    fix_inputs(system, context, measurement_age=np.array([age]))
    sample(system, context)
    autodiff = system.ToAutoDiffXd()
    converted = autodiff.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    # Off the reference, so that the correction counts.
    x = np.concatenate([INPUTS[name] for name in list(INPUTS)[:3]])
    x[:3] += [0.2, -0.3, 0.1]
    parts = np.split(np.arange(18), [12, 15])

    def evaluate(values):
        for name, part in zip(INPUTS, parts, strict=False):
            system.GetInputPort(name).FixValue(context, values[part])
        return commands(system, context)

    gradients = InitializeAutoDiff(x).ravel()
    for name, part in zip(INPUTS, parts, strict=False):
        autodiff.GetInputPort(name).FixValue(converted, gradients[part])
    output = commands(autodiff, converted)
    np.testing.assert_allclose([v.value() for v in output], evaluate(x), rtol=1e-12)
    h = 1e-6
    expected = [(evaluate(x + e) - evaluate(x - e)) / (2 * h) for e in h * np.eye(18)]
    np.testing.assert_allclose(
        ExtractGradient(output.reshape(-1, 1)), np.transpose(expected), atol=1e-7
    )
    assert np.abs(expected).max() > 0.5


def test_autodiff_decides_as_float_does(rings_field):
    system = BranchSupervisor(rings_field, RINGS, (1, 0), 1.5, box=BOX, landing_height=0.2)
    autodiff = system.ToAutoDiffXd()
    context, converted = system.CreateDefaultContext(), autodiff.CreateDefaultContext()
    fix_inputs(system, context, measurement_age=np.array([0.5]))
    for name, value in INPUTS.items():
        autodiff.GetInputPort(name).FixValue(converted, InitializeAutoDiff(value).ravel())
    autodiff.GetInputPort("measurement_age").FixValue(
        converted, InitializeAutoDiff([0.5]).ravel()
    )
    assert autodiff.GetLaps(converted) == 1.5
    sample(system, context)
    sample(autodiff, converted)
    expected = context.get_discrete_state(0).CopyToVector()
    values = converted.get_discrete_state(0).CopyToVector()
    np.testing.assert_array_equal([v.value() for v in values], expected)
    memory = Memory.FromVector(expected)
    assert (memory.mode, memory.branch) == (Mode.HOLD, 1.0)


def test_memory_survives_its_vector():
    rng = np.random.default_rng(0)
    vector = rng.standard_normal(Memory.AtStart(1, 3).ToVector().size)
    memory = Memory.FromVector(vector)
    np.testing.assert_array_equal(memory.ToVector(), vector)
    assert memory.control_points.shape == (6, 3)


def test_parameters_are_read_at_the_next_sample(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    fix_inputs(system, context, measurement_age=np.array([0.5]))
    system.SetHoldAfter(context, 0.6)
    sample(system, context)
    assert system.GetOutputPort("mode").Eval(context) == Mode.FOLLOW
    system.SetHoldAfter(context, 0.4)
    sample(system, context)
    assert system.GetOutputPort("mode").Eval(context) == Mode.HOLD
    system.SetLandAfter(context, 0.45)
    sample(system, context)
    assert system.GetOutputPort("mode").Eval(context) == Mode.LAND
    assert (system.GetHoldAfter(context), system.GetLandAfter(context)) == (0.4, 0.45)


def test_parameters_are_in_the_context(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    assert system.GetBranch(context) == ON_TOUR
    system.SetBranch(context, 1)
    system.SetLaps(context, 2.5)
    clone = context.Clone()
    assert (system.GetBranch(clone), system.GetLaps(clone)) == (1, 2.5)
    assert system.GetBranch(system.CreateDefaultContext()) == ON_TOUR


def test_measurement_is_fresh_where_its_age_is_not_connected(rings_field):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    for name in list(INPUTS)[:4]:
        system.GetInputPort(name).FixValue(context, INPUTS[name])
    sample(system, context)
    assert system.GetOutputPort("mode").Eval(context) == Mode.FOLLOW


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_input_that_is_not_finite_is_named(rings_field, name, value):
    system = BranchSupervisor(rings_field, RINGS)
    system.set_name("pilot")
    bad = INPUTS[name].copy()
    bad[-1] = value
    context = system.CreateDefaultContext()
    context.SetTime(1.5)
    fix_inputs(system, context, **{name: bad})
    with pytest.raises(NonFiniteValueError, match=rf"pilot: input port '{name}'.*t = 1.5 s"):
        sample(system, context)


@pytest.mark.parametrize("name", ["velocity_command", "acceleration_feedforward"])
def test_command_that_is_not_finite_does_not_pass(rings_field, name):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    fix_inputs(system, context, **{name: np.array([0.0, math.nan, 0.0])})
    with pytest.raises(NonFiniteValueError, match=f"input port '{name}'"):
        commands(system, context)


@pytest.mark.parametrize("branch", [2, -3, 0.5, math.nan])
def test_branch_that_does_not_exist_is_refused(rings_field, branch):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match="branch must be one of"):
        system.SetBranch(context, branch)
    fix_inputs(system, context)
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, branch)
    with pytest.raises(ConfigurationError, match="branch must be one of"):
        sample(system, context)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
@pytest.mark.parametrize("name", ["Laps", "HoldAfter", "LandAfter"])
def test_bad_parameter_is_refused(rings_field, name, value):
    system = BranchSupervisor(rings_field, RINGS)
    context = system.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match="must be finite and positive"):
        getattr(system, f"Set{name}")(context, value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tour": (2,)}, "tour"),
        ({"laps": 0.0}, "laps"),
        ({"period": 0.0}, "period"),
        ({"landing_height": math.inf}, "landing_height"),
        ({"box": ([0.0, 0.0], [1.0, 1.0])}, "branch 0 is not inside the box"),
        ({"branches": ()}, "at least one branch"),
    ],
)
def test_bad_argument_is_refused(rings_field, arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        BranchSupervisor(rings_field, **{"branches": RINGS, **arguments})


def test_field_of_another_dimension_is_refused():
    field = TwoRings(2)
    field.dim = 4
    with pytest.raises(ConfigurationError, match="dimension 2 or 3, got 4"):
        BranchSupervisor(field, RINGS)
