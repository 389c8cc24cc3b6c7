"""Sections of itineraries, and agents that are led along them."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import brentq

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator, NavigatorState
from sgvf_drake.paths.planning import covering, shortest
from sgvf_drake.paths.sections import sections
from tests.networks import straight_network
from tests.sgvf_drake.paths.test_itinerary import SQUARE, found, random_network

NAMES = ["T", "Y", "Y in space", "grid", "roundabout", "X", "eight", "rose of three"]
NAMES += ["trefoil", "spiral", "circle", "star"]
SIGMA = 0.1
"""In U."""


def arms(*degrees):
    """Straight arms of length 4 from one node, the first from the left; they come in."""
    angle = np.radians([180.0, *degrees])
    ends = 4 * np.column_stack([np.cos(angle), np.sin(angle)])
    places = np.concatenate([[[0.0, 0.0]], ends])
    return straight_network(places, [(k, 0) for k in range(1, len(places))])


def tangents_along(itinerary, a, b, sigma):
    """The tangents between two arc lengths, on chords of sigma, as far as a field resolves."""
    s = np.linspace(a, b, 40)
    if itinerary.closed:
        lower, upper = (s - sigma / 2) % itinerary.length, (s + sigma / 2) % itinerary.length
    else:
        lower, upper = np.maximum(s - sigma / 2, a), np.minimum(s + sigma / 2, b)
    steps = itinerary.line.at(upper) - itinerary.line.at(lower)
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def check_sections(itinerary, sigma):
    found_sections = sections(itinerary, sigma)
    at = 0.0
    ends = np.append(itinerary.starts[1:], itinerary.length)
    for section in found_sections:
        assert section.begin == pytest.approx(at, abs=1e-9)
        assert section.end > section.begin
        at = section.end
        place = itinerary.edge_at((section.begin + section.end) / 2)
        assert itinerary.edges[place] == section.edge
        assert section.end <= ends[place] + 1e-9
        if section.node is not None:
            assert section.node == itinerary.nodes[place]
        assert np.linalg.norm(section.direction) == pytest.approx(1)
        # Behind a turn chords across the node are not along the edge.
        begin = section.begin + section.turns * sigma / 2
        if begin < section.end and not (section.turns and section.node is not None):
            # Ahead of a corner, as of a node, g is the direction behind it: by at most what is
            # there at 90 degrees.
            lead = (0.88 * 2.58 + 1) * sigma
            # Short of the next node, where the line may turn round.
            end = max(section.end, min(section.end + lead, ends[place] - sigma))
            cosines = tangents_along(itinerary, begin, end, sigma) @ section.direction
            reach = math.ceil(len(cosines) * lead / (end - begin))
            inside = np.linspace(begin, end, len(cosines)) <= section.end
            ahead = [cosines[k : k + reach + 1].max() for k in np.flatnonzero(inside)]
            assert min(ahead) > math.cos(math.radians(60))
    return found_sections, at


@pytest.mark.parametrize("name", NAMES)
def test_sections_tile_the_line_and_keep_near_its_tangent(name):
    network = found(name)
    itinerary = covering(network)
    sigma = SIGMA * network.unit_length
    _, end = check_sections(itinerary, sigma)
    # Agents come to rest before they reach the end of the spiral.
    rest = 0.0 if itinerary.closed else 1.5 * sigma
    assert end == pytest.approx(itinerary.length - rest)


@settings(max_examples=30, derandomize=True)
@given(st.integers(0, 10**6), st.integers(4, 9), st.integers(0, 6))
def test_sections_of_tours_over_random_networks(seed, size, extra):
    network = random_network(seed, size, extra)
    itinerary = covering(network)
    parts, end = check_sections(itinerary, SIGMA * network.unit_length)
    assert end == pytest.approx(itinerary.length)
    # About every node g is the direction of the straight edge that follows.
    entries = [k for k, section in enumerate(parts) if section.node is not None]
    assert len(entries) == len(itinerary.edges)
    for k in entries:
        after = parts[(k + 1) % len(parts)]
        step = np.diff(itinerary.line.at(np.array([after.begin, after.end])), axis=0)[0]
        tangent = step / np.linalg.norm(step)
        np.testing.assert_allclose(parts[k].direction, tangent, atol=1e-6)
        np.testing.assert_allclose(after.direction, tangent, atol=1e-6)


@settings(max_examples=40, derandomize=True)
@given(st.integers(0, 10**6), st.integers(4, 9), st.integers(0, 6))
def test_short_and_cut_itineraries_are_completed(seed, size, extra):
    """Also those that end within sigma, or within the turn at a node."""
    network = random_network(seed, size, extra)
    rng = np.random.default_rng(seed)
    edge = network.edges[rng.integers(len(network.edges))].line
    if rng.uniform() < 0.5:
        a, b = rng.uniform(0, edge.length, 2)
        start, target = edge.at(np.array([a, a + min(b, edge.length - a) / 20]))
    else:
        start, target = rng.uniform(0, 8, (2, 2))
    itinerary = shortest(network, start, target)
    sigma = SIGMA * network.unit_length
    _, end = check_sections(itinerary, sigma)
    assert end == pytest.approx(max(itinerary.length - 1.5 * sigma, itinerary.length / 2))
    navigator = Navigator(itinerary, sigma)
    state = navigator.start(itinerary.line.at(np.zeros(1)))
    for arc in np.linspace(0, itinerary.length, 2 + int(itinerary.length / (0.2 * sigma))):
        state = navigator.advance(state, itinerary.line.at(np.array([arc])))
    assert navigator.completed(state) == 1


@pytest.mark.parametrize("degrees", [90, 120, 135, 150, 165])
@pytest.mark.parametrize("kappa", [2.0, 4.0])
def test_the_exit_is_told_where_it_attracts_more(degrees, kappa):
    """Its weight exp(-r^2 / 2 sigma^2) cosh(kappa) is that of the edge that is travelled."""
    exit_angle = 180 - degrees
    network = arms(180 - exit_angle, 0)
    itinerary = Itinerary.along([1, -2], network)
    theta = math.radians(exit_angle)

    def surplus(away):
        exit_weight = math.exp(-((away * math.sin(theta)) ** 2) / 2) * math.cosh(kappa)
        return exit_weight - math.cosh(kappa * math.cos(theta))

    takeover = brentq(surplus, 0.1, 5.0)
    for lag in (0.0, 0.3):
        parts = sections(itinerary, 0.1, kappa, lag)
        lead = next(section for section in parts if section.node == 0)
        assert lead.turns
        assert lead.end == 4.0
        # Less of the lag where the exit leads back.
        early = lag * (1 + math.cos(math.radians(degrees)))
        assert (lead.end - lead.begin - early) / 0.1 == pytest.approx(0.88 * takeover, rel=1e-4)
        np.testing.assert_allclose(lead.direction, network.nodes[2].place / 4, atol=1e-9)


@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_a_corner_of_an_edge_is_led_into_as_a_node_is(lag):
    """An edge along x and then along y is like two that meet at a right angle."""
    places = np.array([[0.0, 0.0], [4.0, 4.0], [8.0, 4.0], [4.0, 8.0]])
    corner = np.array([[4.0, 0.0]])
    network = straight_network(places, [(0, 1), (1, 2), (1, 3)], {0: corner})
    first, second, *_ = sections(Itinerary.parse("1,2", network), 0.1, lag=lag)
    np.testing.assert_allclose(first.direction, [1, 0], atol=0.05)
    np.testing.assert_allclose(second.direction, [0, 1], atol=0.05)
    node = sections(Itinerary.along([1, -2], arms(90, 0)), 0.1, lag=lag)
    lead = next(section.end - section.begin for section in node if section.node == 0)
    assert 4.0 - first.end == pytest.approx(lead, abs=0.03)
    assert not second.turns


def test_what_turns():
    for degrees, turns in ((0, False), (30, False), (60, True), (150, True)):
        parts = sections(Itinerary.along([1, -2], arms(degrees, 200)), 0.1)
        assert [part.turns for part in parts if part.node == 0] == [turns]
    # To and fro: there the end is turned at, 1.5 sigma before it.
    parts = sections(Itinerary.parse("-2,2,-3,3", arms(0, 90)), 0.1)
    (end,) = [part for part in parts if part.node == 2]
    assert (end.turns, end.begin, end.end) == (True, pytest.approx(3.85), 4.0)
    np.testing.assert_allclose(end.direction, [-1, 0], atol=1e-12)


def test_short_edges_are_shared_by_their_nodes():
    """At right angles, 3.5 sigma belong to the node behind and 3.26 to that ahead."""
    places = np.array([[-4.0, 0], [0, 0], [0, 0.4], [4, 0.4], [0, -4], [-4, 0.4]])
    network = straight_network(places, [(0, 1), (1, 2), (2, 3), (1, 4), (2, 5)])
    parts = sections(Itinerary.parse("1,2,3", network), 0.1)
    own = [part for part in parts if part.edge == 2]
    assert [part.node for part in own] == [None, 2]
    takeover = math.sqrt(2 * math.log(math.cosh(4)))
    share = 3.5 / (3.5 + 0.88 * takeover + 1)
    assert own[1].begin - own[0].begin == pytest.approx(0.4 * share)
    np.testing.assert_allclose([part.direction for part in own], [[0, 1], [1, 0]], atol=1e-12)


def test_bad_scales_are_refused():
    itinerary = Itinerary.parse("1,2", SQUARE)
    for arguments, match in (
        ((0.0,), "sigma must be positive and finite, not 0.0"),
        ((0.1, math.inf), "kappa must be positive and finite, not inf"),
        ((0.1, 4.0, -1.0), "the lag must be finite and not negative, not -1.0"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            Navigator(itinerary, *arguments)


def drive(itinerary, sigma, agents, laps, noise, seed=0, step=0.2):
    """Points that move along the line, measured with noise; their arc lengths and states."""
    rng = np.random.default_rng(seed)
    navigator = Navigator(itinerary, sigma, step=step * sigma)
    shifts = rng.uniform(0.5, 1.0, agents) * sigma
    travelled = np.arange(0, laps * itinerary.length - sigma, step * sigma)
    truth, states, state = [], [], None
    for s in travelled[:, None] + shifts:
        on_line = s % itinerary.length if itinerary.closed else s
        x = itinerary.line.at(on_line)
        x = x + noise * sigma * rng.normal(size=x.shape)
        if state is None:
            ahead = itinerary.line.at(on_line + sigma) - itinerary.line.at(on_line)
            state = navigator.start(x, ahead / np.linalg.norm(ahead, axis=1, keepdims=True))
        else:
            state = navigator.advance(state, x)
        truth.append(s)
        states.append(state)
    return navigator, np.array(truth), NavigatorState(*map(np.array, zip(*states, strict=True)))


@pytest.mark.parametrize("name", NAMES)
def test_points_with_noise_pass_all_sections_in_order(name):
    network = found(name)
    itinerary = covering(network)
    sigma = SIGMA * network.unit_length
    laps = 2.1 if itinerary.closed else 1.0
    navigator, truth, state = drive(itinerary, sigma, 8, laps, noise=0.3)
    assert np.diff(state.section, axis=0).min() >= 0
    last = NavigatorState(*(array[-1] for array in state))
    np.testing.assert_array_equal(navigator.completed(last), int(laps))
    # Each is entered and left at its guards, but for the noise and where corners are cut.
    guards = np.array([section.end for section in navigator.sections])
    if not itinerary.closed:
        guards = np.append(guards, itinerary.length)
    lap, number = np.divmod(state.section, len(guards))
    # Those who seem to be before the start begin at the end of a lap.
    lap = lap - np.round((state.arc[0] - truth[0]) / itinerary.length)
    begins = np.concatenate([[0.0], guards[:-1]])
    early = begins[number] + lap * itinerary.length - truth
    late = truth - guards[number] - lap * itinerary.length
    # At an end both strands are the same, and at a tip of 36 degrees they are near.
    back = name == "star" or (itinerary.closed and any(n.degree == 1 for n in network.nodes))
    assert early.max() < (1.3 + 1.5 * back) * sigma
    assert late.max() < 1.3 * sigma


def test_an_eight_is_crossed_straight():
    """An agent's place never leaves its strand, and its direction is along the strand."""
    network = found("eight")
    itinerary = covering(network)
    sigma = SIGMA * network.unit_length
    navigator, truth, state = drive(itinerary, sigma, 20, 3.0, noise=0.3, seed=2)
    assert np.abs(state.arc - truth).max() < 1.5 * sigma
    for arc in (0.0, itinerary.starts[1]):
        x = itinerary.line.at(np.array([arc]))
        heading = itinerary.line.at(np.array([arc + sigma])) - x
        started = navigator.start(x, heading / np.linalg.norm(heading))
        assert math.remainder(started.arc[0] - arc, itinerary.length) == pytest.approx(
            0, abs=0.5 * sigma
        )


def test_away_from_a_corner_the_heading_does_not_choose_the_farther_strand():
    """There a field leads to the nearer one, where the direction of the other is across."""
    corner = Itinerary.along([1, -2], arms(90, 0), closed=False)
    navigator = Navigator(corner, 0.1)
    x, h = np.array([[-0.8, 0.7], [-0.1, 0.0]]), np.array([[0.0, 1.0], [0.0, 1.0]])
    state = navigator.start(x, h)
    np.testing.assert_allclose(state.arc, [3.2, 4.0], atol=0.02)


def test_agents_in_a_batch_are_as_if_alone():
    network = found("roundabout")
    navigator = Navigator(covering(network), SIGMA)
    rng = np.random.default_rng(3)
    x = rng.uniform(-5, 5, (30, 2))
    h = rng.normal(size=(30, 2))
    state = navigator.start(x, h)
    alone = [navigator.start(x[[k]], h[[k]]) for k in range(30)]
    for _ in range(40):
        x = x + 0.1 * rng.normal(size=x.shape) + 0.05 * navigator.direction(state)
        state = navigator.advance(state, x)
        alone = [navigator.advance(own, x[[k]]) for k, own in enumerate(alone)]
    np.testing.assert_array_equal(state.section, [own.section[0] for own in alone])
    np.testing.assert_allclose(state.arc, [own.arc[0] for own in alone])


def test_agents_turn_round_before_they_come_to_rest():
    """One that would rest .5 sigma before the end is told to go back, and is followed back."""
    itinerary = Itinerary.parse("-2,2,-3,3", arms(0, 90))
    navigator = Navigator(itinerary, 0.1)
    state = navigator.start(np.array([[2.0, 0.0]]), np.array([[1.0, 0.0]]))
    out = [(x, 1) for x in np.arange(2.0, 3.83, 0.02)]
    coast = [(x, -1) for x in (3.86, 3.9, 3.93, 3.95, 3.95, 3.94)]
    back = [(x, -1) for x in np.arange(3.9, 0.4, -0.02)]
    arcs = []
    for x, sign in [*out, *coast, *back]:
        state = navigator.advance(state, np.array([[x, 0.0]]))
        np.testing.assert_allclose(navigator.direction(state), [[sign, 0]], atol=1e-12)
        arcs.append(state.arc[0])
    np.testing.assert_allclose(arcs[: len(out)], [x for x, _ in out])
    np.testing.assert_allclose(arcs[-len(back) :], [8 - x for x, _ in back])


def test_a_completed_itinerary_leaves_no_direction():
    network = arms(90, 0)
    itinerary = shortest(network, [-3.0, 0.1], [0.0, 2.0])
    navigator = Navigator(itinerary, 0.1)
    state = navigator.start(np.array([[-3.0, 0.0], [0.0, 1.84]]))
    np.testing.assert_array_equal(navigator.completed(state), [0, 0])
    state = navigator.advance(state, np.array([[-2.9, 0.0], [0.0, 1.86]]))
    np.testing.assert_array_equal(navigator.completed(state), [0, 1])
    np.testing.assert_allclose(navigator.direction(state), [[1, 0], [0, 0]], atol=1e-9)
    # Nobody is before its start.
    before = navigator.start(np.array([[-3.2, 0.0]]))
    for _ in range(3):
        before = navigator.advance(before, np.array([[-3.2, 0.0]]))
        np.testing.assert_array_equal(before.arc, 0)
    # It stays completed.
    state = navigator.advance(state, np.array([[-2.8, 0.0], [0.0, 1.5]]))
    np.testing.assert_array_equal(navigator.completed(state), [0, 1])


def test_agents_thrown_off_start_anew_ahead():
    """At the nearest place that is left of the itinerary, also where it has been before."""
    network = arms(90, 0)
    there = Itinerary.along([1, -2, 2, -3], network, closed=False)
    navigator = Navigator(there, 0.1)
    # On the way to the first turn, at arc 6, thrown to the first arm: the third is ahead.
    at = navigator.advance(
        navigator.start(np.array([[0.0, 2.0]]), np.array([[0.0, 1.0]])), np.array([[0.0, 2.0]])
    )
    np.testing.assert_allclose(at.arc, 6)
    for x, arc in (([3.0, 0.1], 15), ([0.0, 3.8], 7.8), ([-3.0, -0.1], 12.0)):
        np.testing.assert_allclose(
            navigator.advance(at, np.array([x])).arc, arc, atol=0.125 * 0.1
        )


def test_no_lap_is_counted_that_was_not_made():
    network = found("circle")
    itinerary = covering(network)
    navigator = Navigator(itinerary, SIGMA)
    line, length = itinerary.line, itinerary.length
    rng = np.random.default_rng(5)
    for begin, shift in rng.uniform([0, 0.1], [1, 0.45], (20, 2)) * length:
        shift *= rng.choice([-1, 1])
        state = navigator.start(line.at(np.array([begin])))
        thrown = line.at(np.array([(begin + shift) % length]))
        np.testing.assert_allclose(
            navigator.advance(state, thrown).arc, begin + shift, atol=0.1 * SIGMA
        )


def test_agents_far_away_are_followed_to_the_line():
    """Whoever comes near from far away is where its nearest place is; no lap is counted."""
    itinerary = covering(found("circle"))
    navigator = Navigator(itinerary, SIGMA)
    angle = np.radians(np.arange(0, 360, 30))
    rays = np.column_stack([np.cos(angle), np.sin(angle)])
    state = navigator.start(9 * rays)
    for radius in np.arange(9.0, 4.0, -0.1):
        state = navigator.advance(state, radius * rays)
    np.testing.assert_array_equal(navigator.completed(state), 0)
    nearest = navigator.start(4 * rays)
    np.testing.assert_allclose(state.arc, nearest.arc, atol=SIGMA)
