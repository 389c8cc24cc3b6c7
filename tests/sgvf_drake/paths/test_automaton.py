"""The automaton of a network: guards, directions, and what its parts run along."""

import numpy as np
import pytest

from sgvf_drake.paths.automaton import Automaton
from sgvf_drake.paths.itinerary import Itinerary, successors
from sgvf_drake.paths.polyline import arc_lengths
from sgvf_drake.paths.sections import EXIT, sections
from tests.networks import straight_network

SIGMA = 0.1
TEE = ([[-4, 0], [0, 0], [4, 0], [0, -4]], [(0, 1), (1, 2), (3, 1)])
# An edge that turns by 90 degrees, and one that is too short for two turns.
CORNER = ([[0, 0], [4, 4], [4.3, 4]], [(0, 1), (1, 2)], {0: np.array([[4.0, 0.0]])})


@pytest.fixture(params=[TEE, CORNER], ids=["tee", "corner"])
def network(request):
    return straight_network(*request.param)


def test_every_edge_and_every_turn_is_cut_once(network):
    automaton = Automaton.of(network, SIGMA)
    following = successors(network)
    assert automaton.edges.keys() == following.keys()
    assert set(automaton.turns) == {(k, after) for k in following for after in following[k]}
    for number, cut in automaton.edges.items():
        length = arc_lengths(cut.line)[-1]
        assert (np.diff(cut.guards) > 0).all()
        assert len(cut.directions) == len(cut.guards) - 1
        np.testing.assert_allclose(np.linalg.norm(cut.directions, axis=1), 1)
        for after in following[number]:
            assert cut.guards[-1] <= automaton.turns[number, after] < length


def test_a_turn_begins_where_that_of_an_itinerary_does():
    network = straight_network(*TEE)
    turns = Automaton.of(network, SIGMA).turns
    for number, after in turns:
        first = next(
            section
            for section in sections(
                Itinerary.along([number, after], network, closed=False), SIGMA, lag=0.0
            )
            if section.node is not None
        )
        assert turns[number, after] == pytest.approx(first.begin)


def test_parts_lie_end_to_end(network):
    automaton = Automaton.of(network, SIGMA)
    for before, after in automaton.turns:
        edges = [automaton.edges[number] for number in (before, after)]
        line = automaton.line_of(before, after, None)
        np.testing.assert_allclose(line[0], edges[0].at(edges[0].guards[-1]))
        np.testing.assert_allclose(line[-1], edges[1].at(edges[1].guards[0]))
        for index in range(len(edges[0].directions)):
            part = automaton.line_of(before, before, index)
            length = np.diff(edges[0].guards)[index]
            assert arc_lengths(part)[-1] == pytest.approx(length)


def test_guards_are_left_out():
    whole = Automaton.of(straight_network(*CORNER), SIGMA)
    last = len(whole.edges[1].guards) - 1
    assert last > 1
    kept = {number: range(len(cut.guards)) for number, cut in whole.edges.items()}
    cut = whole.keeping({**kept, 1: (0, last)}).edges[1]
    np.testing.assert_array_equal(cut.guards, whole.edges[1].guards[[0, last]])
    np.testing.assert_array_equal(cut.directions, whole.edges[1].directions[-1:])


def test_a_turn_is_over_before_the_first_guard():
    cut = Automaton.of(straight_network(*TEE), SIGMA).edges[2]
    assert cut.guards[0] > EXIT * SIGMA
    np.testing.assert_allclose(cut.entry, [1, 0], atol=1e-12)
