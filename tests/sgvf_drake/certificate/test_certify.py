"""Certificates: what is certified is so in simulation, and what is not is refused."""

import ctypes
import ctypes.util
from dataclasses import replace
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake import certify
from sgvf_drake.certificate import Cells, Certificate, check, document
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.tube import TICK
from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath


def test_the_search_certifies_a_ring(ring):
    field, path, stored = ring
    found = certify(field, path, levels=True)
    assert found.certified, found.reason
    assert found.area_fraction == pytest.approx(stored.area_fraction, abs=0.01)
    (piece,), (known,) = found.pieces, stored.pieces
    assert (piece.orbit_exists, piece.orbit_unique) == (True, True)
    np.testing.assert_allclose(piece.e_star, known.e_star, atol=0.01)
    assert found.e_star_max == max(piece.e_star) > 0.8
    assert found.entry_time_bound == piece.entry_times[-1]
    assert found.counterexample is None
    c_out = stored.levels.conditions.c_out
    assert found.levels.conditions.c_out == pytest.approx(c_out, rel=1e-3)
    # Without levels all else is the same.
    plain = certify(field, path)
    assert plain == replace(found, levels=None, boxes=plain.boxes)


@pytest.mark.full
def test_two_rings_have_an_orbit_each(make_ring):
    field, path = make_ring(1.6, 4.0)
    found = certify(field, path)
    assert found.certified, found.reason
    assert [piece.orbit_unique for piece in found.pieces] == [True, True]
    laps = [piece.lap_time_high for piece in found.pieces]
    assert laps[0] < laps[1]
    assert check(found, field, path).certified
    # What is around one piece says nothing of the other.
    swapped = replace(found, tubes=found.tubes[::-1], walls=found.walls[::-1])
    assert not check(swapped, field, path).certified


def test_the_unit_of_the_waypoints_does_not_matter(make_ring, ring):
    _, _, own = ring
    field, path = make_ring(4.0, scale=1000.0)
    found = check(replace(own, field_digest=field_digest(field), levels=None), field, path)
    assert found.area_fraction == pytest.approx(own.area_fraction)
    (piece,), (known,) = found.pieces, own.pieces
    for name in ("lap_time_low", "tube_half_width", "wall_half_widths", "entry_times"):
        expected = 1000 * np.array(getattr(known, name))
        np.testing.assert_allclose(getattr(piece, name), expected, rtol=1e-6)
    np.testing.assert_allclose(piece.e_star, known.e_star, rtol=1e-6)


def test_planted_obstacles_are_refused(make_ring):
    """The tangent (z_0, 0) turns around where it crosses the ring."""
    field, path = make_ring(4.0, tangent=[[1.0, 0.0], [0.0, 0.0]])
    found = certify(field, path)
    assert not found.certified
    point = np.array([found.counterexample])
    assert np.linalg.norm(field(point)) < 1e-6
    assert path.project(point).distance[0] < 0.3
    assert "vanishes" in found.reason
    assert (found.walls, found.e_star_max) == ((None,), None)
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


def test_a_proof_anew_tells_how_far_it_is(ring):
    field, path, certificate = ring
    told = []
    assert check(certificate, field, path, progress=lambda *now: told.append(now)).certified
    stages = ["tubes and walls", "cells", "levels"]
    assert [now for now in told if now[1] == 0] == [(stage, 0, 1) for stage in stages]
    assert [now for now in told if now[1] == now[2]] == [(stage, 1, 1) for stage in stages]


def test_a_field_that_settles_beside_the_path_is_certified_for_where_it_settles(ring):
    """By .3 U, as networks from elsewhere may: the certificate tells how far that is."""
    field, path, _ = ring
    beside = path.rescaled(1 - 0.3 / 4)
    found = certify(field, beside)
    assert found.certified, found.reason
    assert 0.3 < found.orbit_half_width < 0.32 + found.pieces[0].tube_half_width
    assert found.area_fraction > 0.95


def larger(piece, name, factor):
    return replace(piece, **{name: tuple(factor * x for x in getattr(piece, name))})


def test_a_stronger_claim_is_told(ring):
    field, path, own = ring
    (piece,) = own.pieces
    stronger = [
        replace(own, area_fraction=own.area_fraction + 1e-3),
        replace(own, orbit_half_width=0.5 * own.orbit_half_width),
        replace(own, pieces=(larger(piece, "e_star", 1.001),)),
        replace(own, pieces=(larger(piece, "entry_times", 0.9),)),
        replace(own, pieces=(replace(piece, lap_time_high=piece.lap_time_low),)),
        replace(own, levels=replace(own.levels, alpha=2 * own.levels.alpha)),
        replace(own, levels=replace(own.levels, tube_half_width=0.01)),
    ]
    for claimed in stronger:
        assert not own.is_as_strong_as(claimed)
        assert claimed.is_as_strong_as(own)
    longer = replace(piece, e_star=(*piece.e_star, 0.9))
    assert not own.is_as_strong_as(replace(own, pieces=(longer,)))
    assert not replace(own, certified=False).is_as_strong_as(own)
    # A check proves everything anew, and refuses what is not so.
    found = check(stronger[2], field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")
    assert replace(found, certified=True).is_as_strong_as(own)


def test_a_certificate_is_that_of_its_field(ring):
    field, path, certificate = ring
    other = replace(field, sigma=field.sigma * (1 + 1e-15))
    with pytest.raises(ConfigurationError, match="another field"):
        check(certificate, other, path)


def changed_digit(text):
    """The text with one digit of the area that was proved changed."""
    start = text.rindex('"area_fraction": ') + len('"area_fraction": 0.')
    digit = text[start]
    return text[:start] + str((int(digit) + 1) % 10) + text[start + 1 :]


def without_walls(text):
    """The text of a certificate that lacks a key, under the right digest."""
    body = json.loads(text)
    head = {name: body.pop(name) for name in ("format", "version", "digest")}
    del body["walls"]
    return json.dumps({**head, "digest": document._digest(body), **body})


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (changed_digit, "was changed"),
        (lambda text: text.replace('"certified": true', '"certified": false'), "was changed"),
        (lambda text: text[: len(text) // 2], "no JSON document"),
        (lambda text: "", "no JSON document"),
        (lambda text: "[1, 2]", "not a file of the format"),
        (lambda text: '{"format": "another"}', "not a file of the format"),
        (lambda text: text.replace('"version": 4', '"version": 1'), "version 1, not of 4"),
        (lambda text: json.dumps({**json.loads(text), "more": 1}), "was changed"),
        (without_walls, "walls"),
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


@pytest.mark.parametrize("spoil", [moved_off, widened, in_space])
def test_a_tube_that_holds_no_orbit_is_refused(ring, spoil):
    """Under a right digest: what the file says is not what is proved."""
    field, path, certificate = ring
    tubes = tuple(map(spoil, certificate.tubes))
    spoilt = replace(certificate, tubes=tubes, walls=(None,), cells=None)
    found = check(spoilt, field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")
    assert found.tubes == (None,)
    assert found.pieces[0].lap_time_high is None


def moved(walls):
    """The outermost wall on the left moved by a thousandth of the path's extent."""
    *others, last = walls.left
    step = round(8e-3 / TICK)
    return replace(walls, left=(*others, tuple((x + step, y) for x, y in last)))


def turned_round(walls):
    """Left for right: walls that m crosses outward."""
    return replace(walls, left=walls.right, right=walls.left)


def far_out(walls):
    """With one more pair of walls, so far out that it holds the centre of the ring."""
    inward, outward = (
        tuple((round(k * x), round(k * y)) for x, y in side[-1])
        for k, side in ((-0.1, walls.left), (1.3, walls.right))
    )
    return replace(walls, left=(*walls.left, inward), right=(*walls.right, outward))


def replace_vertices(walls, change):
    return replace(
        walls, left=tuple(map(change, walls.left)), right=tuple(map(change, walls.right))
    )


@pytest.mark.parametrize("spoil", [moved, turned_round, far_out])
def test_walls_that_are_not_those_that_were_proved_are_refused(ring, spoil):
    field, path, certificate = ring
    (walls,) = certificate.walls
    found = check(replace(certificate, walls=(spoil(walls),), levels=None), field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")


@pytest.mark.parametrize(
    "change",
    [
        lambda own: {"walls": ()},
        lambda own: {"tubes": (replace(own.tubes[0], closed=False),)},
        lambda own: {"walls": (replace_vertices(own.walls[0], lambda wall: wall[1:]),)},
    ],
    ids=["no walls", "an open tube", "a vertex less"],
)
def test_parts_that_do_not_fit_are_refused_and_not_an_error(ring, change):
    field, path, certificate = ring
    found = check(replace(certificate, **change(certificate)), field, path)
    assert not found.certified
    assert found.reason.startswith("what is claimed is not what is proved")


def test_an_end_is_no_counterexample(half_circle_field):
    """Where robots of an open path are to rest, m vanishes as it should."""
    field = half_circle_field
    apart = replace(field, composition=replace(field.composition, gain=-field.composition.gain))
    found = certify(apart)
    assert not found.certified
    assert (found.reason, found.counterexample) == ("no tube is proved of piece 1", None)


def test_a_square_that_is_left_out_is_told(ring):
    field, path, certificate = ring
    first, *rest = certificate.cells
    spoilt = replace(certificate, cells="".join([f"{15 - int(first, 16):x}", *rest]))
    with pytest.raises(ConfigurationError, match="not the code of a quadtree"):
        Certificate.from_json(spoilt.to_json())
    # Coarser squares prove less.
    coarse = replace(certificate, cells=Cells.first().code)
    found = check(coarse, field, path)
    assert not found.certified
    assert found.area_fraction < 0.5


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
    middle = ReferencePath((Piece(field.cloud.denormalize(tube.rows[:-1, 0]), closed=True),))
    assert middle.project(late).distance.max() <= piece.tube_half_width
    assert path.project(late).distance.max() < certificate.orbit_half_width
