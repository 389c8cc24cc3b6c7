"""The automaton of a route in C decides as the one in Python does, on the same positions."""

import ctypes
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.export import export_c
from sgvf_drake.fields import RobustComposition
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator, NavigatorState
from sgvf_drake.paths.planning import covering, shortest
from tests.c_code import CField
from tests.sgvf_drake.fields.test_directed import field_of
from tests.sgvf_drake.paths.test_itinerary import found

SIGMA = 0.1


class State(ctypes.Structure):
    _fields_ = (
        ("route", ctypes.c_int),
        ("section", ctypes.c_long),
        ("arc", ctypes.c_double),
        ("begin", ctypes.c_double),
    )


class Agent:
    """An agent that the code leads along a route."""

    def __init__(self, code, route, x, heading=None):
        self.code, self.state = code, State()
        code.library.field_route_step.restype = ctypes.c_long
        code.library.field_route_completed.restype = ctypes.c_long
        start = code.library.field_route_start
        start(ctypes.byref(self.state), route, _pointer(x), _pointer(heading))

    def step(self, x):
        """Moves it on; returns its section and the intended direction."""
        g = np.empty(self.code.dim)
        step = self.code.library.field_route_step
        return step(ctypes.byref(self.state), _pointer(x), _pointer(g)), g

    @property
    def completed(self):
        return self.code.library.field_route_completed(ctypes.byref(self.state))


def _pointer(array):
    if array is None:
        return None
    assert array.dtype == np.float64
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def field_on(name):
    """A field of any strands, with a network as its own."""
    network = found(name)
    vertices = np.concatenate([edge.line.vertices for edge in network.edges])
    field = field_of("two-way", network.dim)
    return replace(
        field,
        cloud=PointCloud(vertices),
        sigma=SIGMA,
        composition=RobustComposition(0.2, SIGMA),
        path_network=network,
    )


def itineraries(name):
    """Over everything, over a part of it, and between two places."""
    network = field_on(name).network
    whole = covering(network)
    half = Itinerary.along(whole.edges[: 1 + len(whole.edges) // 2], network, closed=False)
    start, target = whole.line.at(np.array([0.2, 0.4]) * whole.length)
    return [whole, half, shortest(network, start, target)]


def walk(itinerary, sigma, rng):
    """Positions beside a line, of which some are far away, and which jump ahead once."""
    length = itinerary.length * (1.3 if itinerary.closed else 1.1)
    arcs = np.arange(0, length, 0.4 * sigma)
    arcs[len(arcs) // 2 :] += 8 * sigma
    on_line = itinerary.line.at(
        arcs % itinerary.length if itinerary.closed else arcs.clip(0, itinerary.length)
    )
    x = on_line + 0.5 * sigma * rng.standard_normal(on_line.shape)
    far = rng.integers(len(x), size=3)
    x[far] += 30 * sigma * rng.standard_normal((3, x.shape[1]))
    return x


@pytest.mark.parametrize("name", ["T", "eight", "Y in space", "roundabout", "spiral"])
def test_the_same_decisions_on_the_same_positions(name, tmp_path):
    """Of three agents, of which one has no heading at the start."""
    field, routes = field_on(name), itineraries(name)
    code = CField(field, tmp_path, routes=routes)
    assert code.summary["routes"] == [",".join(map(str, one.edges)) for one in routes]
    rng = np.random.default_rng(1)
    for route, itinerary in enumerate(routes):
        navigator = Navigator(itinerary, field.memory_length)
        x = np.stack([walk(itinerary, field.memory_length, rng) for _ in range(3)], axis=1)
        h = rng.standard_normal(x[0].shape)
        agents = [
            Agent(code, route, place, heading)
            for place, heading in zip(x[0], (*h[:2], None), strict=True)
        ]
        starts = navigator.start(x[0, :2], h[:2]), navigator.start(x[0, 2:])
        state = NavigatorState(*(np.concatenate(parts) for parts in zip(*starts, strict=True)))
        assert [agent.state.section for agent in agents] == state.section.tolist()
        for places in x:
            state = navigator.advance(state, places)
            sections, directions = zip(*map(Agent.step, agents, places), strict=True)
            assert list(sections) == state.section.tolist()
            arcs = [agent.state.arc for agent in agents]
            np.testing.assert_allclose(arcs, state.arc, rtol=0, atol=1e-10)
            np.testing.assert_array_equal(directions, navigator.direction(state))
        completed = [agent.completed for agent in agents]
        assert completed == navigator.completed(state).tolist()
        assert max(completed) == 1


def test_a_position_that_is_not_finite_changes_nothing(tmp_path):
    field = field_on("T")
    code = CField(field, tmp_path)
    agent = Agent(code, 0, np.zeros(2))
    before = agent.step(np.zeros(2))
    arc = agent.state.arc
    for bad in (np.nan, np.inf):
        section, g = agent.step(np.array([0.0, bad]))
        assert (section, agent.state.arc) == (before[0], arc)
        np.testing.assert_array_equal(g, before[1])


def test_by_default_there_is_a_route_over_each_piece(tee_field, tmp_path):
    summary = export_c(tee_field, tmp_path)
    tour = covering(tee_field.network)
    assert summary["routes"] == [",".join(map(str, tour.edges))]
    header = (tmp_path / "field.h").read_text()
    assert f"0: closed, edges {summary['routes'][0]}\n" in header
    with pytest.raises(ConfigurationError, match="there is no edge 9"):
        export_c(tee_field, tmp_path, routes=["9"], overwrite=True)
