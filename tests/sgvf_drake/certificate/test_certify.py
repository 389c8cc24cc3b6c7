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
from sgvf_drake.certificate import certificate as module
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.path_following import prove
from sgvf_drake.certificate.tube import prove_tube
from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.metrics import grid_starts


def function_of(field, certificate):
    return LyapunovFunction(GaussianMixture(field.mixture.points, certificate.sigma))


def test_the_search_certifies_a_ring(ring):
    field, path, stored = ring
    found = certify(field, path)
    assert found.certified, found.reason
    assert found.conditions.c_out == pytest.approx(stored.conditions.c_out, rel=1e-3)
    (piece,) = found.pieces
    assert (piece.orbit_exists, piece.holes) == (True, 1)
    assert (found.counterexample, found.undecided) == (None, 0)
    assert found.alpha > 0
    assert 0.5 < found.delta <= 1.001
    assert 0 < found.area_fraction <= 1
    assert 0 < found.decrease_fraction <= 1
    assert path.project(field.cloud.points).distance.max() < found.tube_half_width


def test_robots_enter_the_tube_in_time_and_stay(ring):
    field, _, certificate = ring
    V = function_of(field, certificate)
    c_in, c_out = certificate.conditions.c_in, certificate.conditions.c_out
    starts = grid_starts(field.cloud.box, 400, 2)
    level = V(starts)
    starts = starts[(level <= c_out) & (level > c_in)][::8]
    assert len(starts) > 10
    times = np.linspace(0, 3 * certificate.entry_time_bound, 200)
    for start in starts:
        found = solve_ivp(lambda _, x: field(x), times[[0, -1]], start, t_eval=times, rtol=1e-8)
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
        for start in inside[:: len(inside) // 6]:
            found = solve_ivp(lambda _, x: field(x), (0, 40), start, max_step=0.2, rtol=1e-7)
            levels = V(found.y.T)
            assert (np.diff(levels[levels > c_out]) < 0).all()
            assert levels[-1] <= c_out


def test_levels_tolerate_what_is_said_steps_may_be_so_long_and_the_area_is_there(ring):
    field, _, certificate = ring
    V = function_of(field, certificate)
    x = np.random.default_rng(0).uniform(*field.cloud.box, (40_000, 2))
    level, gradient = V.value_and_gradient(x)
    below = (certificate.conditions.c_out >= level).mean()
    reached = (max(part.level for part in certificate.parts) >= level).mean()
    assert 0.9 * below < certificate.area_fraction < reached + 0.02
    inside = (level >= certificate.levels[0]) & (level < certificate.levels[-1])
    x, level, gradient = x[inside], level[inside], gradient[inside]
    m = field(x)
    inward = -(gradient * m).sum(axis=1) / np.linalg.norm(gradient, axis=1)
    claimed = np.array(certificate.e_star)[np.searchsorted(certificate.levels, level) - 1]
    assert (inward >= claimed).all()
    assert (V(x + 0.999 * certificate.step_bound * m) < level).all()


@pytest.mark.full
def test_two_rings_have_an_orbit_each(make_ring):
    field, path = make_ring(1.6, 4.0)
    found = certify(field, path)
    assert found.certified, found.reason
    assert [piece.holes for piece in found.pieces] == [1, 1]
    laps = [piece.lap_time_high for piece in found.pieces]
    assert laps[0] < laps[1]
    # The tube around one piece says nothing of the other.
    swapped = check(replace(found, tubes=found.tubes[::-1]), field, path)
    assert not swapped.certified
    assert [piece.lap_time_high for piece in swapped.pieces] == [None, None]


def test_the_unit_of_the_waypoints_does_not_matter(make_ring, ring):
    _, _, own = ring
    field, path = make_ring(4.0, scale=1000.0)
    (tube,) = own.tubes
    known = tube, prove_tube(field, tube)
    found = prove(field, own.conditions, path, lambda piece, _: known).certificate
    assert found.certified
    for name in ("sigma", "tube_half_width", "entry_time_bound", "step_bound"):
        assert getattr(found, name) == pytest.approx(1000 * getattr(own, name), rel=1e-6)
    assert found.alpha == pytest.approx(own.alpha / 1000, rel=1e-6)
    np.testing.assert_allclose(found.e_star, own.e_star, rtol=1e-6)


def test_planted_obstacles_are_refused(make_ring):
    """The tangent (z_0, 0) turns around where it crosses the ring."""
    field, path = make_ring(4.0, tangent=[[1.0, 0.0], [0.0, 0.0]])
    found = certify(field, path)
    assert not found.certified
    point = np.array([found.counterexample])
    assert np.linalg.norm(field(point)) < 1e-6
    assert path.project(point).distance[0] < 0.3
    assert "vanishes" in found.reason
    assert found.sigma is found.e_star_max is None
    with pytest.raises(ConfigurationError, match="certifies nothing"):
        check(found, field, path)
    # A field that flows out.
    outward = replace(
        make_ring(4.0)[0], score_model=GaussianMixture(np.array([[30.0, 0.0]]), 1.0)
    )
    found = certify(outward, path)
    assert not found.certified
    assert found.reason


def test_a_certificate_is_written_and_read(ring, tmp_path):
    certificate, file = ring[2], tmp_path / "certificate.json"
    certificate.save(file)
    with pytest.raises(OutputExistsError):
        certificate.save(file)
    certificate.save(file, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]
    assert Certificate.load(file) == certificate


def test_a_stronger_claim_is_told(ring):
    field, path, own = ring
    doubled = {"alpha": 2 * own.alpha, "e_star": tuple(2 * value for value in own.e_star)}
    for name, value in (
        *doubled.items(),
        ("tube_half_width", 0.5 * own.tube_half_width),
        ("entry_time_bound", 0.9 * own.entry_time_bound),
    ):
        claimed = replace(own, **{name: value})
        assert not own.is_as_strong_as(claimed)
        assert claimed.is_as_strong_as(own)
    assert not own.is_as_strong_as(replace(own, e_star=(*own.e_star, 0.9)))
    assert not replace(own, certified=False).is_as_strong_as(own)
    # A check proves everything anew, and refuses what is not so.
    found = check(replace(own, alpha=2 * own.alpha), field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")
    assert replace(found, certified=True).is_as_strong_as(own)


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


def test_a_certificate_is_that_of_its_field(ring):
    field, path, certificate = ring
    other = replace(field, sigma=field.sigma * (1 + 1e-15))
    with pytest.raises(ConfigurationError, match="another field"):
        check(certificate, other, path)


def changed_digit(text):
    """The text with one digit of the alpha that was proved changed."""
    start = text.rindex('"alpha": ') + len('"alpha": 0.')
    digit = text[start]
    return text[:start] + str((int(digit) + 1) % 10) + text[start + 1 :]


def without_alpha(text):
    """The text of a certificate that lacks a key, under the right digest."""
    body = json.loads(text)
    head = {name: body.pop(name) for name in ("format", "version", "digest")}
    del body["alpha"]
    return json.dumps({**head, "digest": module._digest(body), **body})


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (changed_digit, "was changed"),
        (lambda text: text.replace('"certified": true', '"certified": false'), "was changed"),
        (lambda text: text[: len(text) // 2], "no JSON document"),
        (lambda text: "", "no JSON document"),
        (lambda text: "[1, 2]", "not a certificate"),
        (lambda text: '{"format": "another"}', "not a certificate"),
        (lambda text: text.replace('"version": 2', '"version": 1'), "version 1, not of 2"),
        (lambda text: json.dumps({**json.loads(text), "more": 1}), "was changed"),
        (without_alpha, "alpha"),
    ],
)
def test_a_file_that_is_not_as_it_was_written_is_refused(ring_file, tmp_path, spoil, reason):
    file = tmp_path / "certificate.json"
    file.write_text(spoil(ring_file.read_text()))
    with pytest.raises(ConfigurationError, match=reason) as error:
        Certificate.load(file)
    assert str(file) in str(error.value)


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


def moved_off(tube):
    """The same tube around another circle, which the orbit does not keep to."""
    return replace(
        tube,
        sections=tuple(
            (tuple(round(1.1 * p) for p in middle), *axes) for middle, *axes in tube.sections
        ),
    )


def widened(tube):
    """A tube with walls 60 times as far from each other, across which robots leave the band."""
    return replace(
        tube,
        sections=tuple((middle, tuple(60 * a for a in axis)) for middle, axis in tube.sections),
    )


def in_space(tube):
    rows = np.zeros((len(tube.sections), 3, 3), int)
    rows[:, :2, :2] = tube.sections
    return replace(tube, sections=tuple(tuple(map(tuple, row)) for row in rows.tolist()))


def opened(tube):
    return replace(tube, closed=False)


@pytest.mark.parametrize("spoil", [moved_off, widened, in_space, opened])
def test_a_tube_that_holds_no_orbit_is_refused(ring, spoil):
    """Under a right digest: what the file says is not what is proved."""
    field, path, certificate = ring
    tubes = tuple(map(spoil, certificate.tubes))
    found = check(replace(certificate, tubes=tubes), field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")
    assert found.tubes == (None,)
    assert found.pieces[0].lap_time_high is None


def test_the_orbit_is_in_its_tube_and_laps_in_time(ring):
    field, path, certificate = ring
    (piece,), unit = certificate.pieces, field.cloud.unit_length
    # How long a lap takes, by the angle that is turned through in 40 s.
    run = solve_ivp(lambda _, x: field(x), (0, 80), [4.5, 0.0], rtol=1e-10, dense_output=True)
    late = run.sol(np.linspace(40, 80, 4000)).T
    lap = 2 * np.pi * 40 / np.ptp(np.unwrap(np.arctan2(late[:, 1], late[:, 0])))
    assert piece.lap_time_low <= lap <= piece.lap_time_high < 1.03 * piece.lap_time_low
    assert piece.orbit_unique
    (tube,) = certificate.tubes
    assert piece.tube_half_width == pytest.approx(tube.half_width * unit)
    boxes, z = tube.boxes, field.cloud.normalize(late)
    assert (np.abs(z[:, None] - boxes.centers).max(axis=2) <= boxes.half).any(axis=1).all()
    assert path.project(late).distance.max() < certificate.orbit_half_width
