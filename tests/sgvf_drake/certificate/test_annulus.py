"""Rings between polygons, and that m points into them."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.orbit_search import propose_annuli
from sgvf_drake.certificate.orbits import Annulus, is_trapping
from tests.helpers import circle


def ring_of(vertices, widths, center=(0.0, 0.0)):
    return Annulus(center, tuple(map(tuple, vertices.tolist())), tuple(widths.tolist()))


def flower(rng, center, count):
    """A star-shaped ring."""
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(0, 0.9, count)) / count
    radii = rng.uniform(1.0, 2.0, count)
    vertices = center + radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return ring_of(vertices, rng.uniform(0.01, 0.5, count), tuple(center.tolist()))


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(8, 60), parts=st.integers(1, 4))
def test_squares_cover_a_ring(seed, count, parts):
    rng = np.random.default_rng(seed)
    annulus = flower(rng, rng.uniform(-3, 3, 2), count)
    assert annulus.is_ring
    inner, outer = annulus.borders
    squares = annulus.squares(parts)
    assert len(squares) % (count * parts**2) == 0
    k, (s, t) = rng.integers(count, size=200), rng.uniform(0, 1, (2, 200, 1))
    ends = [(1 - t) * border[k] + t * border[(k + 1) % count] for border in (inner, outer)]
    points = (1 - s) * ends[0] + s * ends[1]
    away = np.abs(points[:, None] - squares.centers).max(axis=2)
    assert (away <= squares.half).any(axis=1).all()


def test_what_is_no_ring_is_told():
    vertices, widths = circle(2.0, 40), np.full(40, 0.1)
    assert ring_of(vertices, widths).is_ring
    twice = np.concatenate([vertices, vertices])
    for points, reach, center in (
        (vertices[::-1], widths, (0.0, 0.0)),
        (vertices, widths, (5.0, 0.0)),
        (vertices, np.full(40, 2.5), (0.0, 0.0)),
        (vertices, -widths, (0.0, 0.0)),
        (vertices, widths[:-1], (0.0, 0.0)),
        (vertices[[0, 0, *range(1, 39)]], widths, (0.0, 0.0)),
        (twice, np.full(80, 0.1), (0.0, 0.0)),
        (vertices[:2], widths[:2], (0.0, 0.0)),
        (vertices * np.nan, widths, (0.0, 0.0)),
        (vertices, 0 * widths, (0.0, 0.0)),
        (vertices[:0], widths[:0], (0.0, 0.0)),
    ):
        assert not ring_of(points, reach, center).is_ring


@pytest.fixture(scope="module")
def trained(robust_field):
    """A field and a ring around the orbit of its inner piece."""
    field = robust_field
    return field, next(propose_annuli(field, circle(2.0, 80)))


def inward(field, annulus):
    """How fast m goes into the ring at points on its border, seen from outside of the proof."""
    found = []
    for side, border in zip((-1, 1), annulus.borders, strict=True):
        step = np.roll(border, -1, axis=0) - border
        points = border + np.linspace(0, 1, 20)[:, None, None] * step
        m = field(field.cloud.denormalize(points.reshape(-1, 2))).reshape(points.shape)
        cross = step[:, 0] * m[..., 1] - step[:, 1] * m[..., 0]
        found.append(side * cross / np.linalg.norm(step, axis=1))
    return np.concatenate([part.ravel() for part in found])


def test_a_ring_around_the_orbit_traps(trained):
    field, annulus = trained
    assert annulus.is_ring
    assert is_trapping(field, annulus)[0]
    assert inward(field, annulus).min() > 0


def moved(vertices):
    return vertices + np.array([0.05, 0.0])


def dented(vertices):
    """One corner goes across the orbit: the border has to be trapping everywhere."""
    vertices[7] *= 1.02
    return vertices


@pytest.mark.parametrize("spoil", [moved, dented])
def test_a_ring_across_the_orbit_does_not(trained, spoil):
    field, annulus = trained
    vertices = spoil(np.array(annulus.vertices))
    across = replace(annulus, vertices=tuple(map(tuple, vertices.tolist())))
    assert inward(field, across).min() < 0
    assert not is_trapping(field, across)[0]


def test_a_piece_that_is_not_star_shaped_has_no_ring(trained):
    """About a point outside of the circle that it goes around."""
    assert not list(propose_annuli(trained[0], circle(2.0, 80)[:5] + np.array([0.5, 0.0])))
