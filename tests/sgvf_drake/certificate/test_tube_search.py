"""What a tube is laid around: an orbit, its frames and its widths."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.certificate.trajectories import Orbit, closed_orbit, open_orbit
from sgvf_drake.certificate.tube_search import Course, _frame
from tests.fields import exact_field
from tests.helpers import circle


def closed_curve(dim, seed, count=2000):
    """Unit tangents along a random closed curve."""
    angle = np.linspace(0, 2 * np.pi, count)
    waves = np.random.default_rng(seed).normal(size=(2, 3, dim))
    phase = angle[:, None] * [1, 2, 3]
    tangent = np.cos(phase) @ waves[0] + np.sin(phase) @ waves[1]
    return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


@pytest.mark.parametrize("dim", [2, 3, 4])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_frames_are_normal_and_close_and_turn_evenly(dim, seed):
    tangent = closed_curve(dim, seed)
    frame, spin = _frame(tangent, closed=True)
    whole = np.concatenate([tangent[:, :, None], frame], axis=2)
    unit = np.broadcast_to(np.eye(dim), whole.shape)
    np.testing.assert_allclose(whole.swapaxes(1, 2) @ whole, unit, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(whole), 1.0)
    assert frame[-1] == pytest.approx(frame[0])
    # Of the whole turn within the normal space, each step makes its share.
    own = frame[:-1].swapaxes(1, 2) @ np.diff(frame, axis=0)
    turning = (own - own.swapaxes(1, 2)) / 2
    share = np.broadcast_to(spin / (len(tangent) - 1), turning.shape)
    np.testing.assert_allclose(turning, share, rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def course(robust_field):
    orbit = closed_orbit(robust_field, circle(2.0, 80)[0], 4 * np.pi)
    return robust_field, Course.along(robust_field, orbit)


def test_a_closed_orbit_has_its_period(course):
    """Beside another integration, from another place and by another method."""
    field, found = course
    orbit = found.orbit
    start = orbit.at(np.array([0.3 * orbit.duration]))[:, 0]
    run = solve_ivp(
        lambda _, z: field(field.cloud.denormalize(z)),
        (0, orbit.duration),
        start,
        "LSODA",
        rtol=1e-9,
        atol=1e-10,
    )
    assert run.y[:, -1] == pytest.approx(start, abs=1e-5)
    half = run.y[:, np.abs(run.t - orbit.duration / 2).argmin()]
    assert np.linalg.norm(half - start) > 1


def test_widths_spread_as_the_field_does(course):
    """w' = |G| w + 1, which a periodic orbit brings back to where it began."""
    found = course[1]
    assert found.holds_together
    w = found._widths
    middle = (w[1:] + w[:-1]) / 2
    growth = (found.growth[1:] + found.growth[:-1]) / 2
    slope = np.diff(w, axis=0) / np.diff(found.times)[:, None]
    expected = (growth @ middle[..., None])[..., 0] + 1
    assert slope == pytest.approx(expected, abs=0.05)
    assert (w[0] == w[-1]).all()


def test_an_orbit_that_repels_is_not_held_together():
    field = exact_field(circle(4.0, 80), sigma=0.4, gain=-0.8)
    lap = Orbit(
        lambda t: 4.0 * np.array([np.cos(t / 4), np.sin(t / 4)]), 8 * np.pi, closed=True
    )
    assert not Course.along(field, lap).holds_together


def test_orbits_end_or_do_not(half_circle_field, ring):
    start = half_circle_field.cloud.normalize(half_circle_field.path.pieces[0].vertices[0])
    orbit = open_orbit(half_circle_field, start, 4 * np.pi)
    end = orbit.at(np.array([orbit.duration]))[:, 0]
    assert np.linalg.norm(end - orbit.rest.center) <= 0.6 * orbit.rest.radius
    assert closed_orbit(half_circle_field, start, 4 * np.pi) is None
    assert open_orbit(ring[0], np.array([4.0, 0.0]), 8 * np.pi) is None
