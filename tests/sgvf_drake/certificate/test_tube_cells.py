"""Parts of cells: what they cover, and that halving them is exact."""

from fractions import Fraction

import numpy as np
import pytest

from sgvf_drake.certificate.tube import LARGEST, TICK
from sgvf_drake.certificate.tube_cells import HALVINGS, Answer, Parts, divide


def random_parts(dim, seed, size=1.0):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-size, size, (2, 6, dim, dim))
    return Parts(start, end, np.arange(6))


def image(parts, t, s):
    """F(t, s) by its definition, for t (n,) and s (n, r); (parts, n, d)."""
    at = [rows[:, :1] + s @ rows[:, 1:] for rows in (parts.start, parts.end)]
    return (1 - t[:, None]) / 2 * at[0] + (1 + t[:, None]) / 2 * at[1]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("side", [0, -1, 1])
def test_models_are_those_of_the_map_and_its_derivatives(dim, side):
    parts = random_parts(dim, dim)
    r = dim - 1
    rng = np.random.default_rng(7)
    t, s = rng.uniform(-1, 1, 20), rng.uniform(-1, 1, (20, r))
    if side:
        whole, parts = parts, parts.wall(1, side)
        expected = image(whole, t, np.column_stack([np.full(20, side), s[:, 1:]]))
        s = s[:, 1:]
        assert image(parts, t, s) == pytest.approx(expected)
    patches, columns = parts.patches, parts.columns
    u = np.column_stack([t, s, t[:, None] * s])
    z = patches.centers[:, None] + u @ patches.axes.swapaxes(1, 2)
    assert z == pytest.approx(image(parts, t, s))
    step = 1e-4
    for k, model in enumerate(columns):
        by_t, by_s = step * (k == 0), step * np.eye(1 + s.shape[1])[k, 1:]
        change = image(parts, t + by_t, s + by_s) - image(parts, t - by_t, s - by_s)
        value = model.value[:, None] + u @ model.slopes
        assert value == pytest.approx(change / (2 * step), abs=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_hulls_hold_their_cells(dim):
    rng = np.random.default_rng(dim)
    start = np.zeros((20, dim, dim))
    start[:, 1:] = np.diag(rng.uniform(0.01, 0.1, dim - 1)) @ np.eye(dim)[1:]
    end = start + rng.uniform(-0.01, 0.01, start.shape)
    end[:, 0, 0] += 0.2
    parts = Parts(start, end, np.arange(20))
    hulls = parts.hulls
    t, s = rng.choice([-1.0, 1.0], 60), rng.choice([-1.0, 1.0], (60, dim - 1))
    z = image(parts, t, s) - hulls.centers[:, None]
    u = np.linalg.solve(hulls.axes[:, None], z[..., None])[..., 0]
    assert np.abs(u).max() <= 1 + 1e-12
    assert np.abs(u).max() > 0.9


def test_a_skewed_cell_has_no_hull():
    start, end = np.array([[[[0.0, 0.0], [0.0, 1.0]]], [[[1e-3, 5.0], [0.0, 1.0]]]])
    parts = Parts(start, end, np.arange(1))
    assert not np.isfinite(parts.hulls.axes).all()


def test_halves_are_exact():
    """Sections of whole ticks, halved as often as may be, and once more in the models."""
    rng = np.random.default_rng(0)
    ticks = rng.integers(-LARGEST, LARGEST, (2, 4, 3, 3))
    parts = Parts(*(TICK * ticks), np.arange(4)).wall(2, 1)
    exact = [[Fraction(int(n)) for n in (rows[:, 0] + rows[:, 2]).ravel()] for rows in ticks]
    for _ in range(HALVINGS):
        parts = parts.halves()[len(parts) :]
        exact[0] = [(a + b) / 2 for a, b in zip(*exact, strict=True)]
    patches = parts.patches
    found = [Fraction(x) / Fraction(TICK) for x in patches.centers.ravel()]
    assert found == [(a + b) / 2 for a, b in zip(*exact, strict=True)]


def test_parts_are_halved_until_they_are_decided():
    parts = random_parts(2, 3)
    shortest = {0: 1.0, 1: 0.5, 2: 0.25, 3: 0.0, 4: 1.0, 5: 1.0}

    def ask(part, depth):
        length = np.full(len(part), 0.5**depth)
        wanted = np.array([shortest[cell] for cell in part.cell])
        refuted = part.cell == 4
        return Answer((length <= wanted) & ~refuted, refuted, length[:, None])

    found = divide(parts, ask)
    lengths = np.bincount(found.parts.cell, found.facts[:, 0], minlength=6)
    assert lengths.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0, 1.0]
    assert set(found.open_cells) == {3, 4}
    assert found.asked == 6 + 2 * 3 + 4 * 2 + sum(2**k for k in range(3, HALVINGS + 1))
    first = found.parts[found.parts.cell == 1]
    order = np.argsort(first.start[:, 0, 0] != parts.start[1, 0, 0])
    assert (first.end[order[0]] == first.start[order[1]]).all()
    assert (first.end[order[1]] == parts.end[1]).all()
