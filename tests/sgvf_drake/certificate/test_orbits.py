"""Derivatives over squares, uniqueness of the closed orbit, and bounds of the lap time."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.certificate.boxes import Boxes, Division
from sgvf_drake.certificate.field_model import dual_field
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.orbit_search import propose_annuli
from sgvf_drake.certificate.orbits import NUM_SECTORS, Contraction, Turning
from sgvf_drake.fields import GaussianMixture
from tests.helpers import circle

from .balls import random_patch

seeds = st.integers(0, 2**32 - 1)


def normalised(field, z):
    m, J = field.value_and_jacobian(field.cloud.denormalize(z))
    return m, J * field.cloud.unit_length


@pytest.mark.parametrize("recipe", ["robust", "paper", "exact"])
@settings(max_examples=20)
@given(seed=seeds, exponent=st.integers(-16, -5))
def test_derivatives_are_inside_of_their_models(make_field, recipe, seed, exponent):
    """Held against the analytic Jacobian, which is right to rounding."""
    rng = np.random.default_rng(seed)
    field = make_field(recipe, seed=int(rng.integers(1000)), ends=int(rng.integers(2)))
    patch = random_patch(rng, 2.0**exponent, 2, int(rng.integers(1, 3)))
    with np.errstate(over="ignore", invalid="ignore"):
        models = dual_field(field, patch)
    u = rng.uniform(-1, 1, (40, patch.axes.shape[2]))
    m, J = normalised(field, patch.centers + u @ patch.axes[0].T)
    rounding = 1e-9 * (1 + np.abs(J).max())
    parts = ((models.value, m), (models.slopes[0], J[..., 0]), (models.slopes[1], J[..., 1]))
    for model, values in (*parts, (models.divergence, np.trace(J, 0, 1, 2)[:, None])):
        if np.isfinite(model.remainder).all():
            assert (values >= model.lower - rounding).all()
            assert (values <= model.upper + rounding).all()


@pytest.fixture(scope="module")
def tube(robust_field):
    """A trained field, V, a level whose tube has a ring about each piece, and its squares."""
    field = robust_field
    mixture = GaussianMixture(field.cloud.normalize(field.mixture.points), field.sigma)
    levels = MixtureModel(mixture)
    lowest = levels.level_range(Boxes.points(mixture.points))[0].min()
    levels = replace(levels, lowest=float(lowest))
    return field, levels, 0.03


@pytest.fixture(scope="module")
def annulus(tube):
    """The first ring around the orbit of the inner piece."""
    return next(propose_annuli(tube[0], circle(2.0, 80)))


def of_piece(boxes, radii):
    distance = np.linalg.norm(boxes.centers, axis=1)
    return boxes[(distance > radii[0]) & (distance < radii[1])]


@pytest.mark.full
def test_a_ring_of_a_trained_field_has_one_orbit_with_a_lap_in_the_bounds(tube, annulus):
    field, levels, c_in = tube
    squares = of_piece(levels.squares_below(c_in, Boxes.square(8.0), 2.0**-6), (1.0, 3.0))
    assert Contraction(field, levels, c_in).prove(squares, 2.0**-12).proved
    question = Turning(field, np.array(annulus.center), 1)
    found = question.prove(annulus.squares(), 2.0**-12)
    assert found.proved
    low, high = question.lap_time(found)
    assert high < 1.1 * low

    def turned(_, z):
        return np.arctan2(z[1], z[0])

    turned.direction = 1
    run = solve_ivp(
        lambda _, z: field(field.cloud.denormalize(z)),
        (0, 60),
        [2.0, 0.0],
        events=turned,
        rtol=1e-10,
        atol=1e-12,
    )
    # The angle passes zero once a lap.
    laps = np.diff(run.t_events[0])
    assert len(laps) >= 3
    assert low <= laps.min()
    assert laps.max() <= high


def test_the_lap_time_is_bounded_by_squares_wider_than_a_sector():
    # At the angular speed 1 + cos(angle) / 2 a lap takes 2 pi / sqrt(1 - 1/4).
    angle, width = 2 * np.pi * np.arange(200) / 200, 0.03
    centers = 4 * np.column_stack([np.cos(angle), np.sin(angle)])
    # At most and at least over the angles of a square, which has a half-side of 0.06.
    around = angle[:, None] + np.linspace(-width, width, 61)
    speeds = 1 + np.cos(around) / 2
    facts = np.column_stack([speeds.min(axis=1), speeds.max(axis=1)])
    boxes = Boxes(centers, np.full(200, 0.06))
    found = Division(boxes, facts, 200, None, boxes[:0])
    low, high = Turning(None, np.zeros(2), 1).lap_time(found)
    assert low < 2 * np.pi / np.sqrt(0.75) < high < 1.1 * low


def test_a_square_decides_the_lap_time_in_every_sector_that_it_reaches():
    sector, number = 2 * np.pi / NUM_SECTORS, np.arange(NUM_SECTORS)
    # One of them reaches two sectors farther on both sides than its own.
    wide = number == 100
    angle, width = sector * (number + 0.5), sector * np.where(wide, 2.49, 0.49)
    centers = 4 * np.column_stack([np.cos(angle), np.sin(angle)])
    boxes = Boxes(centers, 4 * np.sin(width) / np.sqrt(2))
    facts = np.where(wide[:, None], [0.1, 4.0], 1.0)
    found = Division(boxes, facts, NUM_SECTORS, None, boxes[:0])
    low, high = Turning(None, np.zeros(2), 1).lap_time(found)
    assert high == pytest.approx(2 * np.pi + 5 * sector * (1 / 0.1 - 1))
    assert low == pytest.approx(2 * np.pi + 5 * sector * (1 / 4.0 - 1))


def test_a_lap_the_other_way_is_refused(tube, annulus):
    question = Turning(tube[0], np.array(annulus.center), -1)
    found = question.prove(annulus.squares(), 2.0**-12)
    assert not found.proved
    assert question.speed_at(found.counterexample[None])[0] < 0


def test_a_field_that_spreads_is_not_said_to_contract(tube, make_ring):
    field, levels, c_in = tube
    backward = replace(field, composition=replace(field.composition, gain=-1.0))
    squares = of_piece(levels.squares_below(c_in, Boxes.square(8.0), 2.0**-5), (1.0, 3.0))
    found = Contraction(backward, levels, c_in).prove(squares, 2.0**-10)
    assert not found.proved
    assert found.counterexample is not None
