"""The tube's border against the closed form of V about a circle, and what is no tube."""

from dataclasses import replace
import json

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import i0e

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import tube, tube_curves
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.paths import PointCloud

RADIUS, SIGMA, C_IN = 2.0, 0.4, 0.5


@pytest.fixture(scope="module")
def field(circle_of_points, make_field):
    """A field of 40 points on a circle; the tangent does not matter to V."""
    cloud = circle_of_points(RADIUS)
    points = cloud.normalize(cloud.points)
    return replace(
        make_field("exact"), cloud=cloud, score_model=GaussianMixture(points, 0.4), seed=7
    )


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


def radii_of(curve):
    return np.hypot(*curve.T)


def test_a_ring_has_a_border_inside_and_one_outside(field, verified):
    curves = tube_curves(field, verified(summary_of(field)))
    inner, outer = sorted(curves, key=lambda curve: radii_of(curve).mean())
    lowest = minimize_scalar(log_profile, bounds=(1.0, 3.0), method="bounded").fun
    for curve, (near, far) in ((inner, (0.5, 1.9)), (outer, (1.9, 3.5))):
        np.testing.assert_array_equal(curve[0], curve[-1])
        # Once around.
        angle = np.unwrap(np.arctan2(*curve.T[::-1]))
        assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi)
        r = np.linspace(near, far, 100_001)
        expected = r[np.abs(log_profile(r) - lowest - C_IN).argmin()]
        np.testing.assert_allclose(radii_of(curve), expected, atol=1e-4)


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


def test_a_tube_as_thin_as_a_cell_is_whole(field):
    # From the path to its border it is 0.008, and a cell is 1/120.
    V, level = LyapunovFunction.of(field, SIGMA), 2e-4
    curves = tube.level_curves(field, SIGMA, level)
    inner, outer = sorted(curves, key=lambda curve: radii_of(curve).mean())
    for curve in (inner, outer):
        np.testing.assert_array_equal(curve[0], curve[-1])
        assert np.abs(V(curve) - level).max() < 0.2 * level
    assert radii_of(inner).max() < radii_of(outer).min()


def test_a_curve_that_leaves_the_box_is_cut_there(field):
    curves = tube.level_curves(field, SIGMA, 30.0)
    lower, upper = field.cloud.box
    for curve in curves:
        assert ((curve >= lower - 1e-9) & (curve <= upper + 1e-9)).all()
        V = LyapunovFunction.of(field, SIGMA)(curve)
        np.testing.assert_allclose(V, 30.0, atol=1e-2)


@pytest.mark.parametrize("scaled", [False, True])
def test_curves_are_in_metres(field, verified, scaled):
    # The verification may have been scaled, or not.
    metric = field.rescaled(0.25)
    summary = summary_of(field)
    if scaled:
        summary = summary_of(metric, sigma=0.25 * SIGMA)
    plain = tube_curves(field, verified(summary_of(field)))
    curves = tube_curves(field, verified(summary), 0.25)
    V = LyapunovFunction.of(metric, 0.25 * SIGMA)
    for curve, original in zip(curves, plain, strict=True):
        np.testing.assert_allclose(curve, 0.25 * original, atol=1e-9)
        np.testing.assert_allclose(V(curve), C_IN, atol=1e-3)


@pytest.mark.parametrize("change", [{"digest": "none"}, {"recipe": "paper"}, {"seed": 8}])
def test_another_field_has_another_tube(field, verified, change):
    folder = verified(summary_of(field, **change))
    with pytest.raises(ConfigurationError, match="is the verification of another field"):
        tube_curves(field, folder)


def test_other_waypoints_have_another_tube(field, verified):
    other = replace(field, cloud=PointCloud(1.01 * field.cloud.points))
    with pytest.raises(ConfigurationError, match="is the verification of another field"):
        tube_curves(other, verified(summary_of(field)))


def test_a_verification_may_have_found_no_tube(field, verified):
    with pytest.raises(ConfigurationError, match="found no tube"):
        tube_curves(field, verified(summary_of(field, c_in=None)))


def test_a_folder_without_verification(field, tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(ConfigurationError, match=f"no verification in {folder}"):
            tube_curves(field, folder)


@pytest.mark.parametrize(
    ("summary", "message"),
    [
        ("{", "cannot read .*summary.json"),
        ("[1, 2]", "holds no results of a verification"),
        ("null", "holds no results of a verification"),
        ('{"seed": 0, "digest": "a"}', "holds no results of a verification"),
    ],
)
def test_damaged_results(field, verified, summary, message):
    with pytest.raises(ConfigurationError, match=message):
        tube_curves(field, verified(summary))


@pytest.mark.parametrize(
    "change", [{"unit_length": 0.0}, {"sigma": "wide"}, {"c_in": "low"}, {"sigma": -0.1}]
)
def test_results_of_no_use(field, verified, change):
    with pytest.raises(ConfigurationError):
        tube_curves(field, verified(summary_of(field, **change)))


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_the_tube_of_a_certificate(ring_field, ring_certificate, tmp_path, scale):
    ring_certificate.save(tmp_path / "certificate.json")
    curves = tube_curves(ring_field, tmp_path, scale)
    sigma = ring_certificate.sigma
    V = LyapunovFunction.of(ring_field.rescaled(scale), scale * sigma)
    assert len(curves) == 2
    for curve in curves:
        np.testing.assert_allclose(V(curve), ring_certificate.conditions.c_in, atol=1e-3)
    for curve, other in zip(
        curves, tube_curves(ring_field, tmp_path / "certificate.json", scale), strict=True
    ):
        np.testing.assert_array_equal(curve, other)


def test_another_field_has_another_certificate(ring_field, ring_certificate, tmp_path):
    ring_certificate.save(tmp_path / "certificate.json")
    other = replace(ring_field, seed=ring_field.seed + 1)
    with pytest.raises(ConfigurationError, match=r"certificate\.json is the certificate of an"):
        tube_curves(other, tmp_path)


def test_bytes_that_are_no_text(field, tmp_path):
    (tmp_path / "summary.json").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ConfigurationError, match=r"cannot read .*summary.json"):
        tube_curves(field, tmp_path)
