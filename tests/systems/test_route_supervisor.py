"""The branch supervisor on directed fields: courses, turns, commands in flight, pieces."""

import math

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import fly_tour
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.passages import passages
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.planning import connection
from systems import BranchAlong, BranchSupervisor, FieldForSpeed, MakeBranches, Mode
from systems.courses import Detour
from systems.supervision import Memory
from tests.helpers import circle
from tests.networks import straight_network

from .flying import RINGS, SPEED, TWO_RINGS, Flight, rms

# m; of the T.
SIZE = 6.0
LEFT, RIGHT, BELOW = [-3.0, 1.5], [3.0, 1.5], [0.0, -1.5]
NORTH = np.array([0.0, 1.0])
# m/s; of the long flights.
FAST = 0.9


@pytest.fixture(scope="module")
def tee(tee_field):
    """A T: a bar from (-3, 1.5) to (3, 1.5), and a stem down to (0, -1.5)."""
    return tee_field


@pytest.fixture(scope="module")
def tee_and_ring(tee):
    """The same with a ring of 1 m to the right of its stem."""
    points = np.concatenate([tee.cloud.points, circle(1.0, 120, (2.0, -0.5))])
    return train(PointCloud(points), TrainingConfig(recipe="exact", max_restarts=0)).field


@pytest.fixture(scope="module")
def arms(tee):
    """The edges of the T that lead to its junction: from the left, the right and below."""
    junction = next(k for k, node in enumerate(tee.network.nodes) if node.degree == 3)
    found = {}
    for k, edge in enumerate(tee.network.edges, start=1):
        x, y = tee.network.nodes[edge.nodes[0] + edge.nodes[1] - junction].place
        name = "below" if y < -1 else "left" if x < 0 else "right"
        found[name] = k if edge.nodes[1] == junction else -k
    return found


def flight_from_below(tee, route, **options):
    """A vehicle that flies up the stem of the T, from its middle."""
    flight = Flight(
        tee,
        (0.0, 0.0, 1.0),
        branches=(BranchAlong(tee, route),),
        supervisor={"laps": 1e3},
        **options,
    )
    flight.guidance.SetHeading(flight.own(flight.guidance), NORTH)
    return flight


def edges_of(flight, network):
    positions = flight.log("state")[:, None, :2]
    return [passage.edge for passage in passages(positions, network)[0]]


def text(*numbers):
    return ",".join(map(str, numbers))


def port(flight, name):
    return flight.supervisor.GetOutputPort(name).Eval(flight.own(flight.supervisor))


def test_a_branch_of_each_piece_runs_over_all_of_its_edges(tee_and_ring):
    branches = MakeBranches(tee_and_ring)
    network = tee_and_ring.network
    assert [branch.closed for branch in branches] == [True, True]
    for piece, branch in enumerate(branches):
        own = {k for k, edge in enumerate(network.edges, 1) if edge.piece == piece}
        assert {abs(number) for number in branch.course.edges} == own
        np.testing.assert_allclose(network.path.project(branch.points).distance, 0, atol=1e-9)


def test_headings_turn_to_the_intended_direction_as_in_flight(tee, arms):
    """Beside the closed form: dh/ds = (g - h) / l from one direction to the next."""
    branch = BranchAlong(tee, text(arms["below"], -arms["left"]))
    course, length = branch.course, tee.memory_length
    sections = course.navigator.sections
    turn = next(s for s in sections if s.turns)
    arcs = turn.begin + length * np.array([0.5, 1.0, 1.5])
    headings, turns = course.Headings(arcs)
    share = np.exp(-(arcs - turn.begin) / length)[:, None]
    expected = share * sections[0].direction + (1 - share) * turn.direction
    np.testing.assert_allclose(headings, expected, atol=1e-9)
    np.testing.assert_allclose(turns, (turn.direction - headings) / length, atol=1e-12)


def test_acceleration_is_the_rate_of_the_velocity_along_a_course(tee, arms):
    branch = BranchAlong(tee, text(arms["below"], -arms["left"]))
    motion = branch.MotionAt(tee, SPEED)
    # The waypoint where most is demanded, by the motion a little further along the field.
    waypoint = np.linalg.norm(motion.acceleration, axis=1).argmax()
    headings, turns = (values[waypoint] for values in branch._headings)
    step = 1e-5
    x = branch.points[waypoint]
    flown = FieldForSpeed(tee, SPEED)
    m = flown(x, headings)
    ahead = flown(x + step * m, headings + step * turns)
    behind = flown(x - step * m, headings - step * turns)
    expected = SPEED**2 * (ahead - behind) / (2 * step)
    assert np.linalg.norm(expected) > 0.1
    np.testing.assert_allclose(motion.acceleration[waypoint], expected, rtol=1e-5)


def test_places_and_waypoints_agree(tee):
    (branch,) = MakeBranches(tee)
    course = branch.course
    for index in range(len(course.edges)):
        arcs = np.append(course.itinerary.starts, course.itinerary.length)
        arc = 0.3 * arcs[index] + 0.7 * arcs[index + 1]
        place = course.itinerary.line.at(np.array([arc]))[0]
        spot = course.OnEdge(index, place)
        assert spot.arc == pytest.approx(arc, abs=tee.memory_length / 8)
        assert course.Index(spot) == index
        np.testing.assert_allclose(
            branch.points[branch.WaypointAt(spot.arc)], place, atol=SIZE / 80
        )


def test_the_way_to_an_edge_is_the_shortest():
    # A loop of edges of 1, 2, 4 and 3 with a tail 5 at its first corner.
    places = [[0, 0], [1, 0], [1, 2], [-3, 2], [0, -1]]
    pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 0)]
    network = straight_network(places, pairs)
    assert connection(network, 5, [3]) == [5, 1, 2, 3]
    assert connection(network, 5, [3, -4]) == [5, -4]
    # It turns round at the end of the tail only.
    assert connection(network, -5, [1]) == [-5, 5, 1]
    assert connection(network, 2, [-2]) == [2, 3, 4, -5, 5, -4, -3, -2]
    assert connection(network, 5, [5]) == [5]
    assert connection(network, 5, []) == []
    course = BranchAlong(_Network(network), "1,2").course
    assert Detour(course, 4, 0, 1).edges == (4, 1, 2)
    assert Detour(course, 5, -4, 1).edges == (5, -4, -3, -2, -1, -5, 5, 1, 2)
    assert Detour(course, 5, -4, -1).edges == (5, -4)


class _Network:
    memory_length = 0.05

    def __init__(self, network):
        self.network = network


def test_a_course_is_flown_over_its_turns_and_ends(tee):
    (branch,) = MakeBranches(tee)
    edges, line = branch.course.edges, branch.course.itinerary.line
    start = (*line.at(np.zeros(1))[0], 1.0)
    flight = Flight(tee, start, branches=(branch,), supervisor={}, speed=FAST)
    flight.guidance.SetHeading(
        flight.own(flight.guidance), branch.course.Direction(branch.course.At(0.0))
    )
    # Each turn at an end takes its time.
    flight.until(1.1 * branch.length / FAST)
    passed = edges_of(flight, tee.network)
    assert passed == list(edges[: len(passed)])
    assert len(passed) >= 5
    assert flight.history() == [("FOLLOW", 0)]
    # What the ports say is where the vehicle is.
    arc = port(flight, "arc")[0]
    np.testing.assert_allclose(line.at(np.array([arc]))[0], flight.state[:2], atol=0.1)
    index = branch.course.itinerary.edge_at(np.array([arc]))[0]
    assert port(flight, "edge")[0] == edges[index]
    heading = flight.guidance.GetHeading(flight.own(flight.guidance))
    np.testing.assert_allclose(heading, port(flight, "intended_direction"), atol=0.05)


def test_an_open_route_ends_at_rest_at_its_end(tee, arms):
    flight = flight_from_below(tee, text(arms["below"], -arms["right"])).until(14.0)
    assert flight.history() == [("FOLLOW", 0), ("HOLD", 0)]
    end = tee.network.edges[abs(arms["right"]) - 1].line
    np.testing.assert_allclose(flight.state[:2], RIGHT, atol=0.05)
    assert np.linalg.norm(flight.state[6:9]) < 0.01
    off = tee.network.path.project(flight.log("state", 1.0)[:, :2]).distance
    assert rms(off) < 0.02
    assert end.length == pytest.approx(3.0, abs=0.05)


def test_a_turn_is_commanded_through_the_context(tee, arms):
    route = text(arms["below"], -arms["left"])
    flight = flight_from_below(tee, route, speed=FAST).until(0.5)
    flight.supervisor.SetRoute(
        flight.own(flight.supervisor), text(arms["below"], -arms["right"])
    )
    flight.until(4.0)
    assert edges_of(flight, tee.network) == [-arms["right"]]
    assert flight.state[0] > 1.0
    # From the other side of the junction, the shortest way leads over the end.
    flight.supervisor.SetRoute(flight.own(flight.supervisor), text(-arms["left"]))
    flight.until(17.0)
    assert edges_of(flight, tee.network) == [-arms["right"], arms["right"], -arms["left"]]
    np.testing.assert_allclose(flight.state[:2], LEFT, atol=0.05)
    assert flight.mode == Mode.HOLD
    # And on from there.
    flight.supervisor.SetRoute(
        flight.own(flight.supervisor), text(arms["left"], -arms["below"])
    )
    flight.until(28.0)
    assert edges_of(flight, tee.network)[-2:] == [arms["left"], -arms["below"]]
    np.testing.assert_allclose(flight.state[:2], BELOW, atol=0.05)


def test_a_turn_is_commanded_through_the_port(tee, arms):
    left, right, below = arms["left"], arms["right"], arms["below"]
    flight = flight_from_below(tee, text(below, -left), speed=FAST)
    next_edge = flight.supervisor.GetInputPort("next_edge")
    value = next_edge.FixValue(flight.own(flight.supervisor), [0.0])
    flight.until(0.5)
    # An edge that cannot follow is not honoured.
    value.GetMutableData().set_value([float(-below)])
    flight.until(0.8)
    assert port(flight, "edge")[0] == below
    value.GetMutableData().set_value([float(-right)])
    flight.until(4.0)
    assert edges_of(flight, tee.network) == [-right]
    # It comes back to the rest of its route, over the end.
    flight.until(17.0)
    assert edges_of(flight, tee.network) == [-right, right, -left]
    assert flight.mode == Mode.HOLD
    np.testing.assert_allclose(flight.state[:2], LEFT, atol=0.05)


def test_a_turn_off_the_last_edge_of_a_route_ends_it_on_the_commanded_edge(tee, arms):
    left, right, below = arms["left"], arms["right"], arms["below"]
    flight = flight_from_below(tee, text(below))
    next_edge = flight.supervisor.GetInputPort("next_edge")
    next_edge.FixValue(flight.own(flight.supervisor), [float(-right)])
    flight.until(12.0)
    assert edges_of(flight, tee.network) == [-right]
    assert flight.mode == Mode.HOLD
    np.testing.assert_allclose(flight.state[:2], RIGHT, atol=0.05)
    # What is commanded at rest, by the port, is not flown: the route is over.
    next_edge.FixValue(flight.own(flight.supervisor), [float(-left)])
    flight.until(13.0)
    assert flight.mode == Mode.HOLD


def test_a_vehicle_that_had_to_hold_goes_on_where_it_was(tee, arms):
    flight = flight_from_below(tee, text(arms["below"], -arms["left"])).until(1.5)
    flight.set_age(0.5)
    flight.until(4.0)
    arc = port(flight, "arc")[0]
    assert flight.mode == Mode.HOLD
    flight.set_age(0.0)
    flight.until(4.05)
    assert flight.mode == Mode.TRANSFER
    assert arc <= port(flight, "arc")[0] <= arc + 2.0 * tee.cloud.unit_length + 0.1
    flight.until(16.0)
    assert edges_of(flight, tee.network) == [-arms["left"]]
    np.testing.assert_allclose(flight.state[:2], LEFT, atol=0.05)


@pytest.mark.full
def test_a_tour_leads_from_piece_to_piece(tee_and_ring):
    field = tee_and_ring
    result = fly_tour(field, field.network.path, (1, 0), speed=SPEED)
    assert result.completed
    assert [leg["piece"] for leg in result.legs] == [1, 0]
    assert result.summary()["cross_track_rms_m"] < 0.02 * field.cloud.unit_length
    log = result.log
    own = [
        passage.edge
        for passage in passages(log[["x", "y"]].to_numpy()[:, None], field.network)[0]
    ]
    assert {abs(number) for number in own} == set(range(1, len(field.network.edges) + 1))


@pytest.mark.full
def test_a_route_that_is_commanded_on_the_way_to_its_piece_is_flown_from_there(tee_and_ring):
    field = tee_and_ring
    branches = MakeBranches(field)
    flight = Flight(field, (0.0, 0.0, 1.0), branches=branches, supervisor={"laps": 1e3})
    flight.guidance.SetHeading(flight.own(flight.guidance), NORTH)
    flight.until(0.5).want(1)
    time = 0.5
    while flight.mode == Mode.FOLLOW:
        time += 0.1
        assert time < 60.0
        flight.until(time)
    # The ring again, as an open route of one lap.
    (ring,) = branches[1].course.edges
    route = Itinerary.along([ring], field.network, closed=False)
    flight.supervisor.SetRoute(flight.own(flight.supervisor), route)
    flight.until(time + 0.02)
    assert (flight.mode, flight.memory.branch, flight.memory.order) == (Mode.TRANSFER, 1, 1)
    # An open route is entered near its start.
    assert port(flight, "arc")[0] <= 0.1 * route.length
    flight.until(time + 24.0)
    assert flight.mode == Mode.HOLD
    np.testing.assert_allclose(flight.state[:2], route.line.vertices[-1], atol=0.05)


@pytest.mark.parametrize(
    ("route", "words"),
    [
        ("1,9", "there is no edge 9"),
        ("1,2", "edges 1 and 2 do not meet"),
        ("1;2", "is no list of edges"),
    ],
)
def test_a_wrong_route_is_refused(tee, route, words):
    system = BranchSupervisor(tee, MakeBranches(tee))
    context = system.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match=words):
        system.SetRoute(context, route)
    assert system.GetRoute(context) is None


def test_a_wrong_next_edge_is_refused(tee):
    system = BranchSupervisor(tee, MakeBranches(tee))
    context = prepared(system)
    for number in (4.0, -9.0, 0.5):
        system.GetInputPort("next_edge").FixValue(context, [number])
        with pytest.raises(ConfigurationError, match=f"of one of the 3 edges, got {number:g}"):
            system.EvalUniquePeriodicDiscreteUpdate(context)


def test_a_field_of_the_position_alone_has_no_routes():
    system = BranchSupervisor(TWO_RINGS, RINGS)
    with pytest.raises(ConfigurationError, match="it has no routes"):
        system.SetRoute(system.CreateDefaultContext(), "1")


def test_a_route_where_no_branch_is_is_refused(tee_and_ring):
    branches = MakeBranches(tee_and_ring)
    system = BranchSupervisor(tee_and_ring, branches[:1])
    ring = text(*branches[1].course.edges)
    with pytest.raises(ConfigurationError, match="no branch is on piece 2"):
        system.SetRoute(system.CreateDefaultContext(), ring)


INPUTS = {
    "position": np.array([0.1, 0.0, 1.0]),
    "velocity": np.array([0.0, SPEED, 0.0]),
    "velocity_command": np.array([0.0, SPEED, 0.0]),
    "acceleration_feedforward": np.zeros(3),
    "speed": np.array([SPEED]),
    "heading": NORTH,
    "next_edge": np.zeros(1),
}


def prepared(system, convert=lambda values: values):
    context = system.CreateDefaultContext()
    for name, values in INPUTS.items():
        system.GetInputPort(name).FixValue(context, convert(values))
    return context


def test_autodiff_decides_as_float_does(tee, arms):
    system = BranchSupervisor(tee, MakeBranches(tee))
    autodiff = system.ToAutoDiffXd()
    memories = []
    for own, convert in (
        (system, lambda values: values),
        (autodiff, lambda values: InitializeAutoDiff(values).ravel()),
    ):
        context = prepared(own, convert)
        own.SetRoute(context, text(arms["below"], -arms["right"]))
        for _ in range(2):
            update = own.EvalUniquePeriodicDiscreteUpdate(context).value(0)
            context.SetDiscreteState(0, update)
        values = own.GetOutputPort("intended_direction").Eval(context)
        direction = [getattr(v, "value", lambda v=v: v)() for v in values]
        np.testing.assert_allclose(direction, NORTH, atol=0.05)
        vector = context.get_discrete_state(0).CopyToVector()
        memories.append([getattr(v, "value", lambda v=v: v)() for v in vector])
    np.testing.assert_allclose(memories[1], memories[0], atol=1e-12)
    memory = Memory.FromVector(np.array(memories[0]))
    assert memory.edge == arms["below"]
    assert memory.order == 1.0


def test_a_route_lives_in_the_context(tee, arms):
    system = BranchSupervisor(tee, MakeBranches(tee))
    context, other = system.CreateDefaultContext(), system.CreateDefaultContext()
    route = Itinerary.parse(text(arms["below"], -arms["right"]), tee.network)
    system.SetRoute(context, route)
    assert system.GetRoute(context) is route
    assert system.GetRoute(other) is None
    clone = context.Clone()
    assert system.GetRoute(clone).edges == route.edges
    assert math.isclose(system.GetBranch(clone), 0)
