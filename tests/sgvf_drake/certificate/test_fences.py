"""Fences: robots do not come in, and what is no fence is told."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake import certify
from sgvf_drake.certificate import basin, find_basin, prove_basin
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.cells import HALF
from sgvf_drake.certificate.fences import Fence, Fences
from sgvf_drake.fields import Perceptron
from sgvf_drake.paths import Piece, ReferencePath
from tests.fields import TURN, exact_field
from tests.helpers import circle

CENTER, RADIUS = np.array([2.4, -2.4]), 1.6


def two_turns():
    """N(z) = TURN (z - c), with c on the side of the diagonal on which z is."""
    diagonal, steep = np.array([[1.0, -1.0]]), 3.0
    # silu(x) - silu(-x) is x, and silu(s + 1) - silu(s - 1) goes from 0 to 2.
    inward = np.concatenate([np.eye(2), -np.eye(2), steep * diagonal, steep * diagonal])
    offset = (TURN @ CENTER)[:, None] * np.array([-1.0, 1.0])
    outward = np.concatenate([TURN, -TURN, offset], axis=1)
    bias = np.array([0.0, 0, 0, 0, 1, -1])
    return Perceptron((inward, outward), (bias, TURN @ CENTER))


@pytest.fixture(scope="module")
def slanted():
    """Two circles with the line between them, and all robots that come to it, at 45 degrees."""
    pieces = [sign * CENTER + circle(RADIUS, 60) for sign in (1, -1)]
    field = exact_field(np.concatenate(pieces), two_turns(), 0.4, gain=0.8)
    path = ReferencePath(tuple(Piece(piece, True) for piece in pieces))
    return field, path, certify(field, path)


def winds(fence, z):
    return Fences((fence,)).around(Boxes.points(z)).within


def orbits(field, starts, duration, count):
    """Where robots are at some times, (times, n, 2), normalised."""

    def rate(_, z):
        return field(field.cloud.denormalize(z.reshape(-1, 2))).ravel()

    times = np.linspace(0, duration, count)
    run = solve_ivp(rate, (0, duration), starts.ravel(), t_eval=times, rtol=1e-6, atol=1e-8)
    return run.y.T.reshape(count, -1, 2)


@pytest.fixture(scope="module")
def upstream(slanted):
    """What is proved where fences begin at squares in which robots may stay, not at zeros."""
    field, _, found = slanted
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(basin, "fences_around_zeros", lambda *_: [])
        return find_basin(field, found.walls)


def test_a_slanted_line_to_a_saddle_costs_little(slanted, upstream, monkeypatch):
    field, _, found = slanted
    assert found.certified, found.reason
    assert found.area_fraction > 0.95
    assert upstream.area > 0.95
    monkeypatch.setattr(basin, "fences_around_zeros", lambda *_: [])
    monkeypatch.setattr(basin, "_beside_lines", lambda *_: [])
    without = find_basin(field, found.walls)
    assert without.fences == ()
    assert without.area < 0.9


def test_robots_do_not_come_in(slanted, upstream):
    field, _, found = slanted
    rng = np.random.default_rng(0)
    assert len(found.fences) == 3
    for fence in (*found.fences, max(upstream.fences, key=lambda one: len(one.polygon))):
        near = fence.vertices[rng.choice(len(fence.vertices), 200)]
        starts = near + rng.uniform(-0.06, 0.06, near.shape)
        # The gates lie outside of the box.
        way = orbits(field, starts[np.abs(starts).max(axis=1) < HALF], 12.0, 600)
        inside = np.array([winds(fence, z) for z in way])
        assert inside[0].sum() > 20
        # Who is out once stays out.
        assert (inside[1:] <= inside[:-1]).all()


def test_what_is_crossed_inward_is_a_gate(slanted):
    field, _, found = slanted
    fence = max(found.fences, key=lambda one: len(one.polygon))
    sides = len(fence.vertices)
    assert len(Fences.proved(field, [fence]).gates) <= 2
    turned = Fence(fence.polygon[::-1])
    assert len(Fences.proved(field, [turned]).gates) > 0.9 * sides
    aside = Fence.through(fence.vertices + np.array([0.3, -0.3]))
    assert 0.3 * sides < len(Fences.proved(field, [aside]).gates) < 0.7 * sides


def test_squares_behind_a_gate_are_not_proved(slanted):
    """Fences whose sides are crossed inward, half of them, are of no use."""
    field, _, found = slanted
    cells = basin.Cells.of(found.cells)
    own = prove_basin(field, cells, found.walls, found.fences)
    assert own.area == found.area_fraction
    aside = [Fence.through(one.vertices + np.array([0.3, -0.3])) for one in found.fences]
    assert prove_basin(field, cells, found.walls, aside).area < own.area - 0.05


@pytest.mark.parametrize(
    "polygon", [(), ((1, 2, 3),), ((0.5, 1.0), (2.0, 2.0), (3.0, 3.0)), ((2**40, 0), (0, 0))]
)
def test_what_is_no_fence(polygon):
    with pytest.raises(ValueError, match="a fence is"):
        Fence(polygon)
