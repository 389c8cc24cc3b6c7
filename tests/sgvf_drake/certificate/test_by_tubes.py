"""Certificates of open paths and in space, where tubes alone are proved."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake import certify
from sgvf_drake.certificate import Certificate, check
from sgvf_drake.certificate.tube import corners
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths import Piece, ReferencePath
from tests.fields import tilted_circle


@pytest.fixture(scope="module")
def spatial():
    field, points = tilted_circle()
    path = ReferencePath((Piece(points, closed=True),))
    return field, path, certify(field, path)


@pytest.fixture(scope="module")
def resting(half_circle_field):
    return half_circle_field, half_circle_field.path, certify(half_circle_field)


@pytest.fixture(params=["spatial", "resting"])
def case(request):
    return request.getfixturevalue(request.param)


def test_it_is_proved_anew_from_its_file(case, tmp_path):
    field, path, found = case
    assert found.certified, found.reason
    assert "from where robots enter is not proved" in found.reason
    assert (found.cells, found.area_fraction, found.e_star_max) == (None, None, None)
    with pytest.raises(ConfigurationError, match="closed paths in the plane only"):
        certify(field, path, levels=True)
    found.save(tmp_path / "certificate.json")
    again = check(Certificate.load(tmp_path / "certificate.json"), field, path)
    assert again.is_as_strong_as(found)
    assert again.pieces == found.pieces


def test_robots_do_what_is_proved_of_a_piece(case):
    field, _, found = case
    (piece,), (tube,) = found.pieces, found.tubes
    start = field.cloud.denormalize(corners(tube.rows)[0, 0])
    times = np.linspace(0, 2 * piece.lap_time_high, 4001)
    run = solve_ivp(lambda _, x: field(x), times[[0, -1]], start, t_eval=times, rtol=1e-9)
    if tube.closed:
        assert (piece.orbit_exists, piece.orbit_unique, piece.rest_radius) == (True, True, None)
        # Once it has settled, it passes a plane across its way again after a lap.
        late = run.y.T[2000:]
        normal = late[1] - late[0]
        side = (late - late[0]) @ normal
        near = np.linalg.norm(late - late[0], axis=1) < 1.0
        passed = np.flatnonzero((side[:-1] < 0) & (side[1:] >= 0) & near[1:])
        lap = times[passed[0] + 1] - times[0]
        step = times[1]
        assert piece.lap_time_low - step <= lap <= piece.lap_time_high + step
    else:
        assert (piece.orbit_exists, piece.orbit_unique) == (False, None)
        center = field.cloud.denormalize(np.array(tube.rest.center))
        away = np.linalg.norm(run.y.T - center, axis=1)
        assert (away[times >= piece.lap_time_high] <= piece.rest_radius).all()
        assert away[times < 0.9 * piece.lap_time_low].min() > piece.rest_radius


def test_the_tube_is_as_near_to_the_path_as_is_told(case):
    field, path, found = case
    rows = found.tubes[0].rows
    walls = field.cloud.denormalize(np.concatenate([corners(rows), rows[:, :1]], axis=1))
    dense = walls[:-1] + np.linspace(0, 1, 20)[:, None, None, None] * np.diff(walls, axis=0)
    off = path.project(dense.reshape(-1, field.dim)).distance.max()
    assert off <= found.orbit_half_width < off + 0.5 * field.cloud.unit_length


def test_a_path_beside_the_tube_counts_with_its_distance(spatial):
    """Whatever path it is held against: a certificate tells how far from it robots go."""
    field, path, found = spatial
    wider = ReferencePath((Piece(1.25 * path.pieces[0].vertices, closed=True),))
    beside = check(found, field, wider)
    assert not beside.certified
    assert beside.orbit_half_width >= found.orbit_half_width + 0.9


def moved(tube):
    sections = ((tuple(int(1.02 * p) for p in row), *axes) for row, *axes in tube.sections)
    return replace(tube, sections=tuple(sections))


def cut(tube):
    """Without the second half of its sections, and so without its end or the way back."""
    return replace(tube, sections=tube.sections[: len(tube.sections) // 2])


@pytest.mark.parametrize("spoil", [moved, cut])
def test_a_tube_that_does_not_hold_is_refused(case, spoil):
    field, path, found = case
    again = check(replace(found, tubes=(spoil(found.tubes[0]),)), field, path)
    assert not again.certified
    assert "no tube is proved of piece 1" in again.reason


def test_a_field_that_flows_away_is_not_certified(spatial):
    field, path, _ = spatial
    away = replace(field, composition=replace(field.composition, gain=-0.8))
    found = certify(away, path)
    assert not found.certified
    assert found.reason == "no tube is proved of piece 1"
    assert (found.tubes, found.orbit_half_width) == ((None,), None)
