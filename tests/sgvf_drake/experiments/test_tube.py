"""The tube's border against the closed form of V about a circle, and what is no tube."""

from dataclasses import replace
import json

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import i0e

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import tube, tube_curves
from sgvf_drake.lyapunov import LyapunovFunction
from tests.fields import exact_field
from tests.helpers import circle

RADIUS, SIGMA, C_IN = 2.0, 0.4, 0.5


@pytest.fixture(scope="module")
def field():
    """A field of 40 points on a circle; the tangent does not matter to V."""
    return replace(exact_field(circle(RADIUS, 40), sigma=0.4), seed=7)


def summary_of(field, **changes):
    summary = {"digest": field.cloud.digest, "recipe": field.recipe, "seed": field.seed}
    summary |= {"c_in": C_IN, "sigma": SIGMA, "unit_length": field.cloud.unit_length}
    return summary | changes


@pytest.fixture
def verified(tmp_path):
    """Writes what a verification leaves, or something else; returns the folder."""

    def write(summary):
        text = summary if isinstance(summary, str) else json.dumps(summary)
        (tmp_path / "summary.json").write_text(text)
        return tmp_path

    return write


def log_profile(r):
    """V + const: minus the log of the mean of N(x; R e, sigma^2) over all directions e."""
    z = r * RADIUS / SIGMA**2
    return (r - RADIUS) ** 2 / (2 * SIGMA**2) - np.log(i0e(z))


def inner_and_outer(curves):
    """The two closed curves about a circle, and their radii."""
    rings = sorted(curves, key=lambda curve: np.hypot(*curve.T).mean())
    for curve in rings:
        np.testing.assert_array_equal(curve[0], curve[-1])
    inner, outer = rings
    return (inner, np.hypot(*inner.T)), (outer, np.hypot(*outer.T))


def test_a_ring_has_a_border_inside_and_one_outside(field, verified):
    rings = inner_and_outer(tube_curves(field, verified(summary_of(field))))
    lowest = minimize_scalar(log_profile, bounds=(1.0, 3.0), method="bounded").fun
    for (curve, radii), (near, far) in zip(rings, ((0.5, 1.9), (1.9, 3.5)), strict=True):
        # Once around.
        angle = np.unwrap(np.arctan2(*curve.T[::-1]))
        assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi)
        r = np.linspace(near, far, 100_001)
        expected = r[np.abs(log_profile(r) - lowest - C_IN).argmin()]
        np.testing.assert_allclose(radii, expected, atol=1e-4)


def test_curves_follow_the_level_to_second_order(monkeypatch, field):
    V = LyapunovFunction.of(field, SIGMA)
    errors = []
    for cells in (75, 150, 300):
        monkeypatch.setattr(tube, "CELLS", cells)
        curves = tube.level_curves(field, SIGMA, C_IN)
        errors.append(max(np.abs(V(curve) - C_IN).max() for curve in curves))
    # Linear interpolation in cells that are halved.
    assert errors[1] <= errors[0] / 2.5
    assert errors[2] <= errors[1] / 2.5
    assert errors[2] <= 2e-3


def test_curves_lie_on_their_level_about_an_ellipse_beside_the_origin():
    field = exact_field(circle(2.0, 60) * [1.0, 0.5] + [1.0, -3.0], sigma=0.4)
    V = LyapunovFunction.of(field)
    curves = tube.level_curves(field, V.sigma, C_IN)
    assert len(curves) == 2
    np.testing.assert_allclose(V(np.concatenate(curves)), C_IN, atol=2e-3)


def test_a_tube_as_thin_as_a_cell_is_whole(monkeypatch, field):
    # From the path to its border it is 0.03, and a cell is 1/30.
    monkeypatch.setattr(tube, "CELLS", 150)
    V, level = LyapunovFunction.of(field, SIGMA), 3e-3
    (inner, inner_radii), (outer, outer_radii) = inner_and_outer(
        tube.level_curves(field, SIGMA, level)
    )
    for curve in (inner, outer):
        assert np.abs(V(curve) - level).max() < 0.2 * level
    assert inner_radii.max() < outer_radii.min()


def test_a_curve_that_leaves_the_box_is_cut_there(field):
    lower, upper = field.cloud.box
    for curve in tube.level_curves(field, SIGMA, 30.0):
        assert ((curve >= lower - 1e-9) & (curve <= upper + 1e-9)).all()
        V = LyapunovFunction.of(field, SIGMA)(curve)
        np.testing.assert_allclose(V, 30.0, atol=1e-2)


def test_curves_are_in_metres(field, verified):
    # The verification may have been scaled, or not.
    metric = field.rescaled(0.25)
    V = LyapunovFunction.of(metric, 0.25 * SIGMA)
    plain = tube_curves(field, verified(summary_of(field)))
    for summary in (summary_of(field), summary_of(metric, sigma=0.25 * SIGMA)):
        curves = tube_curves(field, verified(summary), 0.25)
        for curve, original in zip(curves, plain, strict=True):
            np.testing.assert_allclose(curve, 0.25 * original, atol=1e-9)
            np.testing.assert_allclose(V(curve), C_IN, atol=1e-3)


@pytest.mark.parametrize(
    ("summary", "message"),
    [
        ({"digest": "none"}, "is the verification of another field"),
        ({"recipe": "paper"}, "is the verification of another field"),
        ({"seed": 8}, "is the verification of another field"),
        ({"c_in": None}, "found no tube"),
        ({"c_in": "low"}, "holds no results of a verification"),
        ({"unit_length": 0.0}, "holds no results of a verification"),
        ({"sigma": "wide"}, "holds no results of a verification"),
        ({"sigma": -0.1}, "sigma"),
        ("{", "cannot read .*summary.json"),
        ("[1, 2]", "holds no results of a verification"),
        ("null", "holds no results of a verification"),
        ('{"seed": 0, "digest": "a"}', "holds no results of a verification"),
    ],
)
def test_results_of_no_use(field, verified, summary, message):
    if isinstance(summary, dict):
        summary = summary_of(field, **summary)
    with pytest.raises(ConfigurationError, match=message):
        tube_curves(field, verified(summary))


def test_other_folders(field, verified, tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(ConfigurationError, match=f"no verification in {folder}"):
            tube_curves(field, folder)
    other = replace(field, cloud=PointCloud(1.01 * field.cloud.points))
    with pytest.raises(ConfigurationError, match="is the verification of another field"):
        tube_curves(other, verified(summary_of(field)))
    (tmp_path / "summary.json").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ConfigurationError, match=r"cannot read .*summary.json"):
        tube_curves(field, tmp_path)


def test_the_walls_of_a_certificate(ring_field, ring_certificate, tmp_path):
    file = tmp_path / "certificate.json"
    ring_certificate.save(file)
    for scale, place in ((1.0, tmp_path), (0.25, file)):
        curves = tube_curves(ring_field, place, scale)
        # Of the three pairs the outermost.
        for curve, radius in zip(curves, (3.2, 4.8), strict=True):
            np.testing.assert_allclose(np.hypot(*curve.T), scale * radius)
            np.testing.assert_array_equal(curve[0], curve[-1])
    other = replace(ring_field, seed=ring_field.seed + 1)
    with pytest.raises(ConfigurationError, match=r"certificate\.json is the certificate of an"):
        tube_curves(other, tmp_path)
