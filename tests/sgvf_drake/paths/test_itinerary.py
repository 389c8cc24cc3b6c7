"""Itineraries: read, refused, planned; against brute force on small networks."""

from functools import cache
import itertools
import math

from hypothesis import example, given, settings
from hypothesis import strategies as st
import networkx as nx
import numpy as np
import pytest
from scipy.spatial import Delaunay

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.planning import covering, shortest
from tests.networks import SHAPES, straight_network

# A square whose corners are 1 to 4, with a street out of corner 1 and a diagonal.
PLACES = np.array([[0.0, 0], [4, 0], [4, 3], [0, 3], [-2, 0]])
SQUARE = straight_network(PLACES, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (0, 2)])
# Two places joined by three edges, one of them with a loop at its place.
BOWS = {1: np.array([[2.0, 2.0]]), 2: np.array([[2.0, -1.0]]), 3: np.array([[6.0, 1], [6, -1]])}
THETA = straight_network(np.array([[0.0, 0], [4, 0]]), [(0, 1), (0, 1), (0, 1), (1, 1)], BOWS)


@cache
def found(name):
    """The network of a shape, found once."""
    return find_paths(PointCloud(SHAPES[name].sample(300, 0.02, random=False, seed=1)))


def random_network(seed, size, extra):
    """A spanning tree of random places, and a few more edges between neighbours."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 8, (size, 2))
    near = {
        tuple(sorted((int(a), int(b))))
        for triangle in Delaunay(places).simplices
        for a, b in itertools.combinations(triangle, 2)
    }
    graph = nx.Graph(sorted(near))
    for a, b in graph.edges:
        graph[a][b]["weight"] = rng.uniform()
    tree = nx.minimum_spanning_tree(graph)
    rest = sorted(set(graph.edges) - set(tree.edges))
    chosen = rng.permutation(len(rest))[: min(extra, len(rest))]
    return straight_network(places, sorted(tree.edges) + [rest[k] for k in chosen])


NETWORKS = st.builds(
    random_network, st.integers(0, 10**6), st.integers(4, 9), st.integers(0, 6)
)


def edge_graph(network):
    graph = nx.MultiGraph()
    for k, edge in enumerate(network.edges):
        graph.add_edge(*edge.nodes, key=k, weight=edge.length)
    return graph


def check_walk(itinerary):
    """Its edges meet, its line runs along them, and it turns round at ends only."""
    network, numbers = itinerary.network, itinerary.edges
    lines = []
    for number in numbers:
        vertices = network.edges[abs(number) - 1].line.vertices
        lines.append(vertices if number > 0 else vertices[::-1])
    following = list(itertools.pairwise(range(len(numbers))))
    following += [(len(numbers) - 1, 0)] if itinerary.closed else []
    for before, after in following:
        node = network.nodes[itinerary.nodes[before]]
        np.testing.assert_array_equal(lines[before][-1], node.place)
        np.testing.assert_array_equal(lines[after][0], node.place)
        assert numbers[before] != -numbers[after] or node.degree == 1
    lengths = [network.edges[abs(number) - 1].length for number in numbers]
    np.testing.assert_allclose(itinerary.starts, np.cumsum([0.0, *lengths[:-1]]))
    assert itinerary.length == pytest.approx(sum(lengths))
    for line, start, length in zip(lines, itinerary.starts, lengths, strict=True):
        middle = np.mean(line[:2], axis=0) if len(line) == 2 else line[len(line) // 2]
        arc = start + (
            length / 2
            if len(line) == 2
            else np.linalg.norm(np.diff(line[: len(line) // 2 + 1], axis=0), axis=1).sum()
        )
        np.testing.assert_allclose(itinerary.line.at(np.array([arc]))[0], middle, atol=1e-9)


def test_edges_that_follow_each_other():
    itinerary = Itinerary.parse("1,2,-6", SQUARE)
    assert (itinerary.edges, itinerary.closed) == ((1, 2, -6), True)
    assert itinerary.nodes == (1, 2, 0)
    check_walk(itinerary)
    np.testing.assert_allclose(itinerary.starts, [0, 4, 7])
    np.testing.assert_array_equal(
        itinerary.edge_at([0, 3.9, 4, 11.9, 12.1, 19.5]), [0, 0, 1, 2, 0, 2]
    )
    street = Itinerary.parse("-5, 1,2", SQUARE)
    assert (street.closed, street.nodes) == (False, (0, 1, 2))
    np.testing.assert_array_equal(street.line.vertices, PLACES[[4, 0, 1, 2]])
    # It comes back, but would have to turn round at a junction to repeat; or it is not to.
    assert not Itinerary.parse("5,-5", SQUARE).closed
    assert not Itinerary.along([1, 2, -6], SQUARE, closed=False).closed


def test_plain_loops_and_one_way_paths():
    circle = Itinerary.parse("1", found("circle"))
    assert (circle.closed, circle.nodes) == (True, (None,))
    assert circle.length == circle.network.length
    eight = found("eight")
    assert Itinerary.parse("2,1", eight).closed
    for text, match in (
        ("-1", "edge 1 is one-way and cannot be travelled as -1"),
        ("1,1", "edge 1 does not follow edge 1 on their one-way path"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            Itinerary.parse(text, eight)


def test_bad_itineraries_are_refused():
    for text, match in (
        ("1,x", "'1,x' is no list of edges, as 1,2,-3 is"),
        ("", "'' is no list of edges"),
        ("1.5", "'1.5' is no list of edges"),
        ("9", r"there is no edge 9 \(there are 1 to 6\)"),
        ("1,0", "there is no edge 0"),
        ("2,-5", "edges 2 and -5 do not meet"),
        ("1,-1", "edge 1 cannot turn round at node 2, which is no end"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            Itinerary.parse(text, SQUARE)
    with pytest.raises(ConfigurationError, match="at least one edge"):
        Itinerary.along([], SQUARE)
    with pytest.raises(ConfigurationError, match="edge 1 cannot follow edge 2"):
        Itinerary.along([1, 2], SQUARE, closed=True)


@settings(max_examples=40, derandomize=True)
@given(
    network=NETWORKS, places=st.tuples(*[st.floats(0.02, 0.98)] * 2), seed=st.integers(0, 99)
)
def test_the_shortest_way_is_that_of_the_graph(network, places, seed):
    """Two more nodes, where start and target lie on their edges, make it a plain graph."""
    rng = np.random.default_rng(seed)
    graph, points = edge_graph(network), []
    chosen = rng.integers(len(network.edges), size=2)
    cuts = {}
    for name, k, part in zip("st", chosen, places, strict=True):
        edge = network.edges[k]
        points.append(edge.line.at(np.array([part * edge.length]))[0])
        cuts.setdefault(int(k), []).append((part * edge.length, name))
    for k, own in cuts.items():
        edge = network.edges[k]
        graph.remove_edge(*edge.nodes, key=k)
        chain = [(0.0, edge.nodes[0]), *sorted(own), (edge.length, edge.nodes[1])]
        for (a, one), (b, other) in itertools.pairwise(chain):
            graph.add_edge(one, other, weight=b - a)
    expected = nx.dijkstra_path_length(graph, "s", "t")
    if expected < 1e-6:
        return
    itinerary = shortest(network, *points)
    assert itinerary.length == pytest.approx(expected)
    ends = itinerary.line.vertices[[0, -1]]
    np.testing.assert_allclose(ends, points, atol=1e-9)
    assert not itinerary.closed


def headed(network, edge, part, sign, target):
    """The least length over all walks without turning round but at ends, by enumeration."""
    best, goal, share = math.inf, *target
    stack = [(sign * (edge + 1), (part if sign > 0 else 1 - part), 0.0)]
    while stack:
        number, at, length = stack.pop()
        own = network.edges[abs(number) - 1]
        if abs(number) - 1 == goal and (there := share if number > 0 else 1 - share) >= at:
            best = min(best, length + (there - at) * own.length)
            continue
        length += (1 - at) * own.length
        if length >= min(best, 60.0):
            continue
        node = own.nodes[number > 0]
        arms = [
            s * (k + 1)
            for k, e in enumerate(network.edges)
            for s in (1, -1)
            if e.nodes[s < 0] == node
        ]
        stack += [(after, 0.0, length) for after in arms if after != -number or len(arms) == 1]
    return best


@pytest.mark.parametrize("network", [SQUARE, THETA], ids=["square", "theta"])
def test_the_shortest_way_with_a_heading(network):
    """Whoever heads away from the target has to turn round at an end, or to go round."""
    rng = np.random.default_rng(4)
    for _ in range(40):
        (edge, goal), (part, share) = (
            rng.integers(len(network.edges), size=2).tolist(),
            rng.uniform(size=2),
        )
        start, target = (
            network.edges[k].line.at(np.array([u * network.edges[k].length]))
            for k, u in ((edge, part), (goal, share))
        )
        line = network.edges[edge].line
        ahead = line.at(np.clip(line.length * part + np.array([-1e-3, 1e-3]), 0, line.length))
        for sign in (1, -1):
            itinerary = shortest(network, start[0], target[0], sign * (ahead[1] - ahead[0]))
            expected = headed(network, edge, part, sign, (goal, share))
            assert itinerary.length == pytest.approx(expected)
            assert itinerary.edges[0] == sign * (edge + 1)


def test_one_way_paths_are_travelled_forwards():
    eight = found("eight")
    line = eight.routes[0].line
    for a, b in ((3.0, 10.0), (10.0, 3.0), (20.0, 19.0)):
        start, target = line.at(np.array([a, b]))
        itinerary = shortest(eight, start, target, heading=-start)
        assert itinerary.length == pytest.approx((b - a) % line.length, rel=1e-3)
    # Over the place where a closed line begins, too.
    circle = found("circle")
    start, target = circle.path.pieces[0].at(np.array([20.0, 10.0]))
    around = shortest(circle, start, target)
    assert (around.edges, around.nodes) == ((1, 1), (None, None))
    assert around.length == pytest.approx(circle.length - 10)
    spiral = found("spiral")
    start, target = spiral.routes[0].line.at(np.array([20.0, 10.0]))
    with pytest.raises(
        ConfigurationError, match=r"cannot be reached from .*: their path is one"
    ):
        shortest(spiral, start, target)


def test_the_shortest_way_from_and_to_nodes():
    """Where a foot is a node, nothing is left of the edge that the node ends."""
    itinerary = shortest(SQUARE, PLACES[4], PLACES[2])
    assert (itinerary.edges, itinerary.nodes) == ((-5, 6), (0, 2))
    itinerary = shortest(SQUARE, PLACES[1], [0.0, 1.0])
    assert (itinerary.edges, itinerary.nodes) == ((-1, -4), (0, None))
    np.testing.assert_allclose(itinerary.line.vertices, [[4, 0], [0, 0], [0, 1]])


def test_bad_points_are_refused():
    circles = found("concentric")
    for call, match in (
        (
            lambda: shortest(circles, [4, 0], [2, 0]),
            r"\(2, 0\) cannot be .* \(4, 0\): .* 1 and 2",
        ),
        (lambda: shortest(SQUARE, [0, 0, 0], [1, 1]), r"\(0, 0, 0\) is no point in 2 dim"),
        (lambda: shortest(SQUARE, [0, 0], [math.nan, 1]), r"\(nan, 1\) is no point in 2"),
        (lambda: shortest(SQUARE, [1, 0], [2, 0], [1]), r"\(1\) is no heading in 2"),
        (lambda: shortest(SQUARE, [1, 0], [1, -1]), r"\(1, -1\) is where the itinerary starts"),
        (lambda: covering(SQUARE, 1), r"there is no piece 2 \(there are 1 to 1\)"),
        (lambda: covering(SQUARE, 0, [0]), r"\(0\) is no point in 2"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            call()


def postman(network):
    """The length of the postman's tour: all ways to pair the odd nodes are tried."""
    graph = edge_graph(network)
    odd = [node for node, degree in graph.degree if degree % 2]
    distance = nx.floyd_warshall(graph)

    def least(nodes):
        if not nodes:
            return 0.0
        first, *rest = nodes
        return min(
            distance[first][other] + least([k for k in rest if k != other]) for other in rest
        )

    return network.length + least(odd)


@settings(max_examples=60, derandomize=True)
@given(network=NETWORKS)
@example(network=SQUARE)
@example(network=THETA)
def test_tours_over_every_edge_are_the_postmans(network):
    itinerary = covering(network)
    check_walk(itinerary)
    assert itinerary.closed
    assert {abs(number) for number in itinerary.edges} == set(range(1, 1 + len(network.edges)))
    assert itinerary.length == pytest.approx(postman(network))
    assert itinerary.edges[0] == 1


@pytest.mark.parametrize("name", ["T", "Y", "Y in space", "grid", "roundabout", "X"])
def test_tours_over_networks_that_were_found(name):
    network = found(name)
    itinerary = covering(network)
    check_walk(itinerary)
    assert itinerary.length == pytest.approx(postman(network))
    assert {abs(number) for number in itinerary.edges} == set(range(1, 1 + len(network.edges)))


def test_tours_go_straight_over_crossings():
    network = found("X")
    itinerary = covering(network)
    straight = {frozenset((a + 1, b + 1)) for a, b in (route.edges for route in network.routes)}
    crossing = next(k for k, node in enumerate(network.nodes) if node.kind == "crossing")
    passed = [
        frozenset((abs(itinerary.edges[k]), abs(itinerary.edges[(k + 1) % 8])))
        for k in range(8)
        if itinerary.nodes[k] == crossing
    ]
    # All straight on would be two tours, to and fro: two of the four have to turn.
    assert sum(pair in straight for pair in passed) == 2


def test_tours_of_one_way_paths_are_their_routes():
    knot = found("trefoil")
    route = [edge + 1 for edge in knot.routes[0].edges]
    for first, start in ((1, None), (4, knot.edges[3].line.at(np.array([2.0]))[0])):
        turn = route.index(first)
        assert covering(knot, start=start).edges == (*route[turn:], *route[:turn])
    assert covering(found("spiral")).closed is False
    circles = found("concentric")
    assert [covering(circles, k).edges for k in (0, 1)] == [(1,), (2,)]


def test_tours_start_where_they_are_told():
    assert covering(SQUARE, start=[2.0, 3.1]).edges[0] == 3
    first, third = (covering(SQUARE, start=start) for start in (None, [2.0, 3.1]))
    assert first.length == third.length
