"""Certificates: what is certified is so in simulation, and what is not is refused."""

import ctypes
import ctypes.util
from dataclasses import replace
import json

import numpy as np
import pytest
from scipy import ndimage
from scipy.integrate import solve_ivp

from sgvf_drake import certify
from sgvf_drake.certificate import Certificate, check
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.path_following import prove
from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.metrics import grid_starts


def function_of(field, certificate):
    return LyapunovFunction(GaussianMixture(field.mixture.points, certificate.sigma))


def test_a_ring_is_certified(ring):
    field, path, certificate = ring
    assert certificate.certified, certificate.reason
    (piece,) = certificate.pieces
    assert piece.orbit_exists
    assert piece.holes == 1
    assert certificate.counterexample is None
    assert certificate.undecided == 0
    assert certificate.alpha > 0
    assert 0.5 < certificate.delta <= 1.001
    assert 0 < certificate.area_fraction <= 1
    assert 0 < certificate.decrease_fraction <= 1
    assert path.project(field.cloud.points).distance.max() < certificate.tube_half_width


def test_robots_enter_the_tube_in_time_and_stay(ring):
    field, _, certificate = ring
    V = function_of(field, certificate)
    c_in, c_out = certificate.conditions.c_in, certificate.conditions.c_out
    starts = grid_starts(field.cloud.box, 400, 2)
    level = V(starts)
    starts = starts[(level <= c_out) & (level > c_in)][::4]
    assert len(starts) > 20
    times = np.linspace(0, 3 * certificate.entry_time_bound, 400)
    for start in starts:
        found = solve_ivp(lambda _, x: field(x), times[[0, -1]], start, t_eval=times, rtol=1e-9)
        levels = V(found.y.T)
        assert (np.diff(levels[levels > c_in]) < 0).all()
        assert (levels[times >= certificate.entry_time_bound] <= c_in).all()


def test_robots_come_down_from_what_is_above_the_band(ring):
    field, _, certificate = ring
    V, c_out = function_of(field, certificate), certificate.conditions.c_out
    axes = [np.linspace(*ends, 301) for ends in zip(*field.cloud.box, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    level = V(x.reshape(-1, 2)).reshape(301, 301)
    assert certificate.parts
    for part in certificate.parts:
        labels, _ = ndimage.label((level >= c_out) & (level <= part.level))
        at = (int(np.abs(axis - p).argmin()) for axis, p in zip(axes, part.point, strict=True))
        inside = x[(labels == labels[tuple(at)]) & (level > c_out)]
        assert len(inside) > 100
        for start in inside[:: len(inside) // 15]:
            found = solve_ivp(lambda _, x: field(x), (0, 40), start, max_step=0.1, rtol=1e-8)
            levels = V(found.y.T)
            assert (np.diff(levels[levels > c_out]) < 0).all()
            assert levels[-1] <= c_out


def test_levels_tolerate_what_is_said_and_steps_may_be_so_long(ring):
    field, _, certificate = ring
    V = function_of(field, certificate)
    x = np.random.default_rng(0).uniform(*field.cloud.box, (40_000, 2))
    level, gradient = V.value_and_gradient(x)
    inside = (level >= certificate.levels[0]) & (level < certificate.levels[-1])
    x, level, gradient = x[inside], level[inside], gradient[inside]
    m = field(x)
    inward = -(gradient * m).sum(axis=1) / np.linalg.norm(gradient, axis=1)
    claimed = np.array(certificate.e_star)[np.searchsorted(certificate.levels, level) - 1]
    assert (inward >= claimed).all()
    assert (V(x + 0.999 * certificate.step_bound * m) < level).all()


def test_the_area_is_no_more_than_there_is_and_not_much_less(ring):
    field, _, certificate = ring
    x = np.random.default_rng(1).uniform(*field.cloud.box, (40_000, 2))
    V = function_of(field, certificate)(x)
    below = (certificate.conditions.c_out >= V).mean()
    reached = (max(part.level for part in certificate.parts) >= V).mean()
    assert 0.9 * below < certificate.area_fraction < reached + 0.02


def test_two_rings_have_an_orbit_each(make_ring):
    field, path = make_ring(1.6, 4.0)
    found = certify(field, path)
    assert found.certified, found.reason
    assert [piece.holes for piece in found.pieces] == [1, 1]
    laps = [piece.lap_time_high for piece in found.pieces]
    assert laps[0] < laps[1]
    # The ring around one piece says nothing of the other.
    swapped = check(replace(found, annuli=found.annuli[::-1]), field, path)
    assert not swapped.certified
    assert [piece.lap_time_high for piece in swapped.pieces] == [None, None]


def test_the_unit_of_the_waypoints_does_not_matter(make_ring, ring):
    _, _, own = ring
    field, path = make_ring(4.0, scale=1000.0)
    found = prove(field, own.conditions, path, lambda piece, _: [own.annuli[piece]]).certificate
    assert found.certified
    for name in ("sigma", "tube_half_width", "entry_time_bound", "step_bound"):
        assert getattr(found, name) == pytest.approx(1000 * getattr(own, name), rel=1e-6)
    assert found.alpha == pytest.approx(own.alpha / 1000, rel=1e-6)
    np.testing.assert_allclose(found.e_star, own.e_star, rtol=1e-6)


def test_a_planted_sink_is_refused_with_the_place(make_ring):
    """The tangent (z_0, 0) turns around where it crosses the ring."""
    field, path = make_ring(4.0, tangent=[[1.0, 0.0], [0.0, 0.0]])
    found = certify(field, path)
    assert not found.certified
    point = np.array([found.counterexample])
    assert np.linalg.norm(field(point)) < 1e-6
    assert path.project(point).distance[0] < 0.3
    assert "vanishes" in found.reason
    assert found.sigma is None
    assert found.e_star_max is None


def test_a_field_that_flows_out_is_refused(make_ring):
    field, path = make_ring(4.0)
    outward = replace(field, score_model=GaussianMixture(np.array([[30.0, 0.0]]), 1.0))
    found = certify(outward, path)
    assert not found.certified
    assert found.reason


def test_what_is_claimed_can_be_checked(ring, tmp_path):
    field, path, certificate = ring
    file = tmp_path / "certificate.json"
    certificate.save(file)
    with pytest.raises(OutputExistsError):
        certificate.save(file)
    certificate.save(file, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]
    loaded = Certificate.load(file)
    assert loaded == certificate
    assert check(loaded, field, path).certified


@pytest.mark.parametrize(
    ("name", "claim"),
    [("alpha", 2.0), ("e_star", 2.0), ("tube_half_width", 0.5), ("entry_time_bound", 0.9)],
)
def test_a_stronger_claim_is_told(ring, name, claim):
    value = getattr(ring[2], name)
    stronger = tuple(claim * v for v in value) if name == "e_star" else claim * value
    claimed = replace(ring[2], **{name: stronger})
    assert not ring[2].is_as_strong_as(claimed)
    assert claimed.is_as_strong_as(ring[2])


def test_a_claim_of_more_levels_is_told(ring):
    own = ring[2]
    assert not own.is_as_strong_as(replace(own, e_star=(*own.e_star, 0.9)))


@pytest.mark.parametrize(
    "change",
    [
        *({"alpha": 0.0}, {"alpha": -5.0}, {"delta": 0.0}, {"sigma": 0.0}, {"c_in": 0.0}),
        *({"c_out": 0.0}, {"share": 1.0}, {"share": -0.1}),
        *({"c_out": float("inf")}, {"lowest": float("nan")}, {"sigma": "0.1"}, {"alpha": None}),
    ],
    ids=str,
)
def test_conditions_that_would_say_nothing_are_refused(ring, change):
    """With a speed of zero or an empty band a zero on the path would be no obstacle."""
    with pytest.raises(ConfigurationError, match=next(iter(change))):
        replace(ring[2].conditions, **change)


def test_a_stronger_claim_than_the_proof_is_refused(ring):
    field, path, certificate = ring
    found = check(replace(certificate, alpha=2 * certificate.alpha), field, path)
    assert not found.certified
    assert "not what is proved" in found.reason


def test_a_certificate_is_that_of_its_field(ring):
    field, path, certificate = ring
    other = replace(field, sigma=field.sigma * (1 + 1e-15))
    with pytest.raises(ConfigurationError, match="another field"):
        check(certificate, other, path)


def test_nothing_certified_is_nothing_to_check(make_ring):
    field, path = make_ring(4.0, tangent=[[1.0, 0.0], [0.0, 0.0]])
    with pytest.raises(ConfigurationError, match="certifies nothing"):
        check(certify(field, path), field, path)


def changed_digit(text):
    """The text with one digit of the alpha that was proved changed."""
    start = text.rindex('"alpha": ') + len('"alpha": 0.')
    digit = text[start]
    return text[:start] + str((int(digit) + 1) % 10) + text[start + 1 :]


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (changed_digit, "was changed"),
        (lambda text: text.replace('"certified": true', '"certified": false'), "was changed"),
        (lambda text: text[: len(text) // 2], "no JSON document"),
        (lambda text: "", "no JSON document"),
        (lambda text: "[1, 2]", "not a certificate"),
        (lambda text: '{"format": "another"}', "not a certificate"),
        (lambda text: text.replace('"version": 1', '"version": 9'), "version 1"),
        (lambda text: json.dumps({**json.loads(text), "more": 1}), "was changed"),
    ],
)
def test_a_file_that_is_not_as_it_was_written_is_refused(ring, tmp_path, spoil, reason):
    file = tmp_path / "certificate.json"
    file.write_text(spoil(ring[2].to_json()))
    with pytest.raises(ConfigurationError, match=reason) as error:
        Certificate.load(file)
    assert str(file) in str(error.value)


def test_a_key_that_is_missing_is_refused(ring):
    body = json.loads(ring[2].to_json())
    del body["digest"], body["alpha"], body["format"], body["version"]
    from sgvf_drake.certificate import certificate as module

    text = json.dumps(
        {
            "format": module.FORMAT,
            "version": module.VERSION,
            "digest": module._digest(body),
            **body,
        }
    )
    with pytest.raises(ConfigurationError, match="alpha"):
        Certificate.from_json(text)


def test_fields_in_space_and_with_ends_are_told_before_the_search(make_field):
    with pytest.raises(ConfigurationError, match="planar"):
        certify(make_field("robust", dim=3))
    with pytest.raises(ConfigurationError, match="terminal ends"):
        certify(make_field("robust", ends=1))


@pytest.mark.parametrize("mode", [0x400, 0x800, 0xC00], ids=["down", "up", "to zero"])
def test_nothing_is_proved_where_results_are_rounded_to_one_side(ring, mode):
    """As a library of interval arithmetic may leave the process (x86: fenv.h)."""
    library = ctypes.CDLL(ctypes.util.find_library("m"))
    assert library.fesetround(mode) == 0
    try:
        with pytest.raises(RuntimeError, match="rounded to nearest"):
            check(ring[2], ring[0], ring[1])
    finally:
        assert library.fesetround(0) == 0
    check_rounding()


@pytest.mark.parametrize("width", [0.0, -1.0, 1e-3, 50.0])
def test_a_ring_that_is_none_is_refused(ring, width):
    """Under a right digest: what the file says is not what is proved."""
    field, path, certificate = ring
    (annulus,) = certificate.annuli
    other = replace(annulus, widths=(width,) * len(annulus.widths))
    if width == 1e-3:
        # A ring, but one that the orbit does not keep to.
        other = replace(
            other,
            center=annulus.center,
            vertices=tuple((1.1 * x, 1.1 * y) for x, y in annulus.vertices),
        )
    found = check(replace(certificate, annuli=(other,)), field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")
