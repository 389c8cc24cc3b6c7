"""The verdict on good fields, and on fields that are bad on purpose, with the place."""

from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.lyapunov import (
    LyapunovFunction,
    find_band,
    inward_margins,
    samples,
    take_samples,
    verify,
)
from sgvf_drake.lyapunov.band import LEVEL_MARGIN
from sgvf_drake.lyapunov.verification import STAND_IN, Violation
from sgvf_drake.paths import Piece, ReferencePath
from tests.fields import ACROSS, SPIN, TURN, exact_field, linear_network, tilted_circle
from tests.helpers import circle

# One noise level of V is enough where its choice is not the matter.
ONE = (1.0,)
# A ring of fewer waypoints, where the noise level is not the matter either.
COARSE = {"spacing": 0.25, "sigma": 0.25}


pytestmark = pytest.mark.usefixtures("coarse_grid")


@pytest.fixture(scope="module")
def good(ring, coarse_grid):
    """The verification of the field around a ring of radius 4."""
    return verify(*ring, ratios=ONE)


def test_a_rotation_about_a_ring_holds(ring, good):
    assert good.holds
    assert good.band.tube.follows(np.array([True]))
    again = find_band(ring[0], good.function, good.samples, ring[1], stops=good.zeros.points)
    assert (again.c_in, again.c_out) == (good.band.c_in, good.band.c_out)
    assert good.slowest > 0.99
    assert good.decrease_fraction > 0.99
    assert good.margins.e_star.min() > 0
    assert "V decreases from" in good.reason
    assert "|m| >= " in good.reason


@pytest.mark.parametrize("counts", [True, False])
def test_nothing_holds_where_a_violation_counts(good, counts):
    slow = Violation("slow", np.array([4.0, 0.0]), 0.01, 0.0, 0.0, counts)
    assert replace(good, violations=[slow]).holds is not counts


def test_its_only_zero_is_in_the_hole_and_counts_for_nothing(good):
    # The winding number on the border is one, so there must be one inside.
    zeros = [violation for violation in good.violations if violation.kind == "zero"]
    assert len(zeros) == len(good.zeros.zeros) == 1
    assert not zeros[0].counts
    assert np.linalg.norm(zeros[0].point) < 0.1
    assert good.zeros.zeros[0].index == 1


def test_a_planted_sink_on_the_path_is_found(ring_field, linear):
    sink = np.array([4.0 * np.cos(1.0), 4.0 * np.sin(1.0)])
    place = ring_field(**COARSE)[0].cloud.normalize(sink)
    field, path = ring_field(tangent=linear(-np.eye(2), place), **COARSE)
    found = verify(field, path, ratios=ONE)
    assert not found.holds
    first = found.violations[0]
    assert (first.kind, first.detail, first.counts) == ("zero", "sink", True)
    np.testing.assert_allclose(first.point, sink, atol=0.05)
    assert "m vanishes at (2.1" in found.reason
    assert "a sink" in found.reason


def test_a_zero_between_the_samples_bounds_the_band(ring_field, linear):
    """A linear tangent network vanishes at one point only: here off the grid, in the band."""
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    place = np.array([2.8137, 0.9071])
    network = linear(turn, place)
    # The score is balanced there by nothing, so m = s; shift v until s + v vanishes.
    field, path = ring_field(tangent=network, composition="paper", **COARSE)
    s = field.components(place[None])[0][0]
    network = replace(network, biases=(network.biases[0] - s,))
    field, path = ring_field(tangent=network, composition="paper", **COARSE)
    found = verify(field, path, ratios=ONE)
    zero = found.zeros.points[np.linalg.norm(found.zeros.points - place, axis=1).argmin()]
    V = float(found.function(zero[None])[0])
    assert np.linalg.norm(field(zero)) < 1e-9
    assert found.band is None or not found.band.c_in <= V <= found.band.c_out


def test_alpha_is_the_smallest_decrease_of_all_that_was_seen(ring, good):
    weakest = -good.function.along(ring[0], good.margins.weakest)
    np.testing.assert_allclose(good.margins.decrease, weakest, rtol=1e-9)
    V, V_dot = (
        good.function(good.samples.x),
        good.function.derivative(good.samples.x, good.samples.m),
    )
    inside = (good.band.c_in <= V) & (good.band.c_out >= V)
    assert good.alpha <= min(weakest.min(), -V_dot[inside].max()) * (1 + 1e-9)
    assert good.alpha > 0


def test_a_tangent_without_direction_is_found(ring_field, linear):
    # The same direction everywhere: along the ring, half of it runs against the other half,
    # from a source at (-4, 0) to a sink at (4, 0).
    east = linear(np.zeros((2, 2)))
    east = replace(east, biases=(np.array([0.5, 0.0]),))
    field, path = ring_field(tangent=east, composition="paper", **COARSE)
    found = verify(field, path, ratios=ONE)
    assert not found.holds
    counting = [v for v in found.violations if v.counts and v.kind == "zero"]
    # Where s and v cancel, tanh(k d / sigma^2) = 1/2 beside the ring.
    d = COARSE["sigma"] ** 2 / 0.2 * np.arctanh(0.5)
    assert [violation.detail for violation in counting[:1]] == ["sink"]
    np.testing.assert_allclose(counting[0].point, [4 + d, 0], atol=0.01)
    saddles = [v.point for v in counting if v.detail == "saddle"]
    assert np.linalg.norm(np.array(saddles) - [-4 + d, 0], axis=1).min() < 0.01


def test_no_tangent_is_too_slow(ring_field, linear):
    # m = s alone stops on the ring.
    field, path = ring_field(tangent=linear(np.zeros((2, 2))), **COARSE)
    found = verify(field, path, ratios=ONE)
    assert not found.holds
    assert found.slowest < 0.01
    assert any(violation.kind == "slow" for violation in found.violations)


@pytest.mark.full
def test_a_field_that_flows_out_has_no_band(ring_field, linear, monkeypatch):
    # An area is as exact as the grid is fine.
    monkeypatch.setitem(samples.GRID_SIZES, 2, 301)
    field, path = ring_field(tangent=linear(np.eye(2)), composition="paper", **COARSE)
    found = verify(field, path, ratios=ONE)
    assert not found.holds
    assert found.band is None
    assert found.margins is None
    assert found.reason.startswith("V decreases on no band of levels")
    rises = [violation for violation in found.violations if violation.kind == "rise"]
    assert rises[0].counts
    # All that is outside of the ring and not near to it.
    outside = 10**2 - np.pi * (4 + STAND_IN) ** 2
    assert rises[0].area == pytest.approx(outside, rel=0.02)
    assert np.linalg.norm(rises[0].point) > 4


@pytest.mark.full
def test_an_open_path_may_end(open_field):
    found = verify(open_field, ratios=ONE)
    assert found.holds, found.reason
    assert [component.holes for component in found.band.tube.components] == [0]
    ends = [z for z in found.zeros.zeros if np.linalg.norm(z.point - open_field.ends[0]) < 0.3]
    assert ends
    assert all(zero.kind in ("sink", "focus") for zero in ends if zero.index == 1)


def test_a_trained_field_holds(robust_field, concentric):
    stages = []

    def note(stage, done, total):
        assert done <= total
        stages.append(stage)

    found = verify(robust_field, concentric[1], ratios=ONE, progress=note)
    assert set(stages) == {"sample", "band", "zeros", "conditions"}
    assert found.holds, found.reason
    assert sorted(c.pieces for c in found.band.tube.components) == [(0,), (1,)]
    assert found.band.tube.half_width < 0.1
    assert found.slowest > 0.98
    assert found.assumptions["a2_cosine"]["mean"] < 0.05
    assert found.assumptions["a1_score_curl"] < 0.1
    assert found.bounds[1].holds.all()


def test_fields_beyond_space_are_refused(make_field, ring):
    with pytest.raises(ConfigurationError, match="checked in 2-D and 3-D, not in 4-D"):
        verify(make_field("robust", dim=4), ring[1])


@pytest.fixture(scope="module")
def tilted():
    """A field around a tilted circle in space, the circle, and its verification."""
    field, _ = tilted_circle()
    path = ReferencePath((Piece(circle(4.0, 4096) @ ACROSS, closed=True),))
    return field, path, verify(field, path, ratios=ONE)


def test_a_rotation_about_a_circle_in_space_holds(tilted):
    field, _, found = tilted
    assert found.holds, found.reason
    (component,) = found.band.tube.components
    assert (component.pieces, component.holes, component.cavities) == ((0,), 1, 0)
    assert found.slowest > 0.99
    # The band ends below the lowest level on the border of the box; the axis of the circle, on
    # which a zero of m lies, is above.
    zeros = [violation for violation in found.violations if violation.kind == "zero"]
    assert [(zero.detail, zero.counts) for zero in zeros] == [("saddle", False)]
    assert np.linalg.norm(zeros[0].point) < 0.01
    lower, upper = field.cloud.box
    faces = np.random.default_rng(0).uniform(lower, upper, (3, 2, 40_000, 3))
    for axis, (low, high) in enumerate(zip(lower, upper, strict=True)):
        faces[axis, 0, :, axis], faces[axis, 1, :, axis] = low, high
    border = found.function(faces.reshape(-1, 3)).min()
    assert found.band.c_out == pytest.approx((1 - LEVEL_MARGIN) * border, rel=0.01)
    assert found.band.basin.compact


def test_margins_are_those_of_the_same_circle_in_the_plane(tilted):
    """Flat circles tolerate the same on each level, wherever they lie in space."""
    field, _, found = tilted
    levels = found.margins.levels
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    spun = turned @ SPIN @ turned.T
    unit = field.cloud.unit_length
    points = field.cloud.points
    for cloud, tangent in (
        (PointCloud(points @ turned.T), linear_network(spun, np.zeros(3))),
        (PointCloud(points @ ACROSS.T), linear_network(TURN)),
    ):
        # The same noise and slope in the unit of the waypoints.
        scale = unit / cloud.unit_length
        other = exact_field(cloud, tangent, sigma=0.4 * scale, gain=0.8 * scale)
        function = LyapunovFunction.of(other)
        ends = float(levels[0]), float(levels[-1])
        margins = inward_margins(other, function, take_samples(other), *ends)
        np.testing.assert_allclose(margins.e_star, found.margins.e_star, rtol=0.01)


@pytest.mark.full
def test_a_planted_sink_on_the_path_in_space_is_found(tilted):
    field, path, _ = tilted
    sink = path.pieces[0].vertices[700]
    network = linear_network(-np.eye(3), field.cloud.normalize(sink))
    planted = exact_field(field.cloud, network, sigma=0.4, gain=0.8)
    found = verify(planted, path, ratios=ONE)
    assert not found.holds
    first = found.violations[0]
    assert (first.kind, first.detail, first.counts) == ("zero", "sink", True)
    np.testing.assert_allclose(first.point, sink, atol=0.02)
    assert "m vanishes at (" in found.reason


@pytest.mark.full
def test_where_v_rises_in_space_is_told_with_its_volume(tilted):
    field, path, _ = tilted
    planted = exact_field(
        field.cloud, linear_network(np.eye(3), np.zeros(3)), 0.4, 0.8, composition="paper"
    )
    found = verify(planted, path, ratios=ONE)
    assert found.band is None
    first = next(violation for violation in found.violations if violation.kind == "rise")
    assert first.counts
    # Cells of the grid count as whole ones, so that those on the border reach beyond it.
    half = (found.samples.axes[0][1] - found.samples.axes[0][0]) / 2
    lower, upper = field.cloud.box[0] - half, field.cloud.box[1] + half
    x = np.random.default_rng(1).uniform(lower, upper, (40_000, 3))
    rising = found.function.along(planted, x) > -0.01 / field.cloud.unit_length
    rising &= path.project(x).distance > STAND_IN * field.cloud.unit_length
    total = sum(v.area for v in found.violations if v.kind == "rise")
    assert total == pytest.approx(rising.mean() * (upper - lower).prod(), rel=0.03)
