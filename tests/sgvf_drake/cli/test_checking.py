"""The commands `verify`, `certify` and `singularities`: what they print, leave and refuse."""

from dataclasses import replace
import re

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.certificate import Certificate
from sgvf_drake.certificate.zeros import HALF_WIDTH
from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import load_field
from tests.data.make import FOLDER, field_file
from tests.fields import TURN, exact_field, linear_network, tilted_circle
from tests.helpers import circle, ink, names_in, summary_of

CERTIFICATE = FOLDER.parent / "certificates" / "ring.json"


@pytest.fixture(scope="module")
def fields(tmp_path_factory, make_field):
    """A folder with files of fields, and a ring as a polyline."""
    folder = tmp_path_factory.mktemp("fields")
    # So far apart that each waypoint has a peak of the density, and so near that none has.
    sparse, dense = (exact_field(circle(3.0, n), sigma=0.3, gain=0.8) for n in (40, 100))
    learned = replace(
        make_field("paper"),
        cloud=sparse.cloud,
        tangent_network=linear_network(TURN - 0.2 * np.eye(2)),
    )
    ring = load_field(field_file("ring"))
    sink = linear_network(-np.eye(2), ring.cloud.normalize([0.0, 4.0]))
    for name, field in (
        ("bad", replace(ring, tangent_network=sink)),
        ("sparse", sparse),
        ("dense", dense),
        ("learned", learned),
        ("ring", ring),
        ("stopping", replace(ring, tangent_network=linear_network([[1.0, 0.0], [0.0, 0.0]]))),
        ("open", make_field("robust", ends=1)),
        ("tilted", tilted_circle()[0]),
    ):
        # The cloud has no shape that a reference could be made of.
        field = replace(field, cloud=PointCloud(field.cloud.points))
        field.save(folder / f"{name}.safetensors")
    np.savetxt(
        folder / "ring.csv", sparse.cloud.points, delimiter=",", header="x,y", comments=""
    )
    (folder / "broken.safetensors").write_bytes(b"no field")
    return folder


def words_of(printed):
    return " ".join(printed.replace("│", " ").split())


# verify


@pytest.mark.usefixtures("coarse_grid")
def test_a_good_field_is_verified(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--starts", 16, "--scale", 2.5)
    assert run("verify", fields / "ring.safetensors", *options, "--out", out) == 0
    printed = capsys.readouterr()
    for words in ("sampled conditions", "hold", "band of V", "|cos(s, v)|", "bound, gradient"):
        assert words in printed.out
    assert printed.err == ""
    summary = summary_of(out)
    assert summary["holds"] is True
    # In metres there, of which U has as many as the scale.
    assert summary["unit_length"] == pytest.approx(2.5, rel=1e-3)
    for name, length in (("sigma of V", "sigma"), ("half-width", "tube_half_width")):
        in_units = f"{summary[length] / summary['unit_length']:.3g} U"
        assert f"{name} {in_units}" in words_of(printed.out)


@pytest.mark.usefixtures("coarse_grid")
def test_a_planted_sink_is_named_with_its_place(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("verify", fields / "bad.safetensors", "--out", out) == 0
    printed = capsys.readouterr()
    assert "do NOT hold" in printed.out
    assert "warning: the conditions do not hold" in printed.err
    zeros = [v for v in summary_of(out)["violations"] if v["counts"] and v["kind"] == "zero"]
    at = np.array([zero["point"] for zero in zeros])
    nearest = int(np.linalg.norm(at - [0.0, 4.0], axis=1).argmin())
    np.testing.assert_allclose(at[nearest], [0.0, 4.0], atol=0.05)
    assert zeros[nearest]["detail"] == "sink"


# certify

OF_LEVELS = (
    *("sigma", "c_in", "c_out", "alpha", "delta", "tube_half_width"),
    *("decrease_fraction", "step_bound", "e_star"),
)
KEYS = {
    *("certified", "reason", "area_fraction", "almost_fraction", "excluded", "boxes", "time_s"),
    *("entry_time_bound", "e_star_max", "orbit_half_width", "counterexample", "pieces"),
    *OF_LEVELS,
}


def test_a_certificate_is_proved_anew(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        run("certify", fields / "ring.safetensors", "--check", CERTIFICATE, "--out", out) == 0
    )
    words = words_of(capsys.readouterr().out)
    assert "certified yes" in words
    assert "robots from 99" in words
    assert names_in(out) == {"summary.json", "certificate.json", "certificate.png"}
    summary, stored = summary_of(out), Certificate.load(CERTIFICATE)
    assert set(summary) >= KEYS
    assert (summary["certified"], summary["checked"]) == (True, True)
    (piece,) = summary["pieces"]
    assert piece["orbit_exists"] is True
    assert piece["lap_time_low"] < 8 * np.pi < piece["lap_time_high"]
    assert summary["area_fraction"] == pytest.approx(stored.area_fraction, rel=1e-9)
    assert summary["e_star_max"] == max(piece["e_star"]) > 0.5
    assert summary["entry_time_bound"] == piece["entry_times"][-1]
    assert f"walls {len(piece['e_star'])} pairs, " in words
    assert f"tolerate up to {summary['e_star_max']:.3g} of the speed" in words
    assert Certificate.load(out / "certificate.json").is_as_strong_as(stored)


def test_levels_are_proved_on_request(run, fields, tmp_path, capsys):
    ring = ("certify", fields / "ring.safetensors", "--overwrite", "--out", tmp_path)
    assert run(*ring) == 0
    assert "levels tolerate" not in words_of(capsys.readouterr().out)
    assert [summary_of(tmp_path)[name] for name in OF_LEVELS] == [None] * len(OF_LEVELS)
    assert run(*ring, "--levels") == 0
    words, summary = words_of(capsys.readouterr().out), summary_of(tmp_path)
    levels = Certificate.load(tmp_path / "certificate.json").levels
    assert f"V falls from, to {levels.conditions.c_out:.3g}" in words
    assert f"levels tolerate {min(levels.e_star):.3g} to {max(levels.e_star):.3g}" in words
    assert summary["c_in"] == levels.conditions.c_in
    assert summary["e_star"]["e_star"] == list(levels.e_star)
    assert len(summary["e_star"]["levels"]) == len(levels.e_star) + 1
    for name in ("sigma", "alpha", "delta", "tube_half_width", "step_bound"):
        assert summary[name] == getattr(levels, name) > 0


def test_a_stop_on_the_path_ends_in_status_1_and_a_summary(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("certify", fields / "stopping.safetensors", "--out", out) == 1
    assert "certified NO" in words_of(capsys.readouterr().out)
    summary = summary_of(out)
    assert (summary["certified"], summary["checked"]) == (False, False)
    x, y = summary["counterexample"]
    assert abs(x) < 0.1
    assert abs(abs(y) - 4) < 0.3


def test_an_open_path_is_certified_by_a_tube(run, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("certify", field_file("half_circle"), "--out", out) == 0
    words = words_of(capsys.readouterr().out)
    assert "from where robots enter is not proved" in words
    assert "one to rest within" in words
    summary = summary_of(out)
    assert (summary["certified"], summary["area_fraction"]) == (True, None)
    assert 0 < summary["orbit_half_width"] < 0.5
    assert ink(out / "certificate.png") > 0.01
    # There are no walls that a flight could be held against.
    status = run(
        "fly", field_file("half_circle"), *FLIGHT, "--certificate", out, "--out", tmp_path / "f"
    )
    assert status == 2
    assert "proves nothing of walls" in words_of(capsys.readouterr().err)


FLIGHT = ("--scale", 0.1, "--speed", 1.5, "--laps", 1)


def test_a_flight_is_held_against_the_certificate(run, fields, tmp_path, capsys):
    out, field = tmp_path / "out", fields / "ring.safetensors"
    against = ("--certificate", CERTIFICATE)
    assert run("fly", field, *FLIGHT, "--html", *against, "--out", out) == 0
    flight = {f"flight_1.{kind}" for kind in ("html", "parquet", "png")}
    assert names_in(out) == {"summary.json", "certificate.png", *flight}
    found, claimed = summary_of(out)["certificate"], Certificate.load(CERTIFICATE)
    assert found["e_star_max"] == claimed.e_star_max
    assert len(found["what_it_does_not_cover"]) > 3
    assert found["inside_margin"] is True
    width = 0.1 * claimed.pieces[0].wall_half_widths[0]
    assert found["covering_half_width"] == pytest.approx(width)
    words = words_of(capsys.readouterr().out)
    assert (
        f"inside of what is proved: walls within {width:.3g} m of the orbits hold it" in words
    )
    # A wind takes more of the speed than any walls tolerate.
    windy = (*FLIGHT, "--speed", 0.5, "--wind", "8,0", *against, "--overwrite")
    assert run("fly", field, *windy, "--out", out) == 0
    assert summary_of(out)["certificate"]["inside_margin"] is False
    assert "NOT inside of what is proved" in words_of(capsys.readouterr().out)
    # Without a certificate, its figure does not stay.
    assert run("fly", field, *FLIGHT, "--overwrite", "--out", out) == 0
    assert "certificate" not in summary_of(out)
    assert not (out / "certificate.png").exists()


# singularities


def test_the_zeros_of_a_ring(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    ring = ("--reference", fields / "ring.csv", "--columns", "x,y")
    assert run("singularities", fields / "sparse.safetensors", *ring, "--out", out) == 0
    printed = capsys.readouterr()
    for words in (
        "zeros of the guiding field 1 focus",
        "40 sink",
        "40 saddle",
        "1 centre; indices sum up to 1, winding number 1",
        "undecided places 0",
        "score vanishes at low density no (",
        "score vanishes near branches nothing to tell by",
    ):
        assert words in words_of(printed.out)
    assert printed.err == ""
    summary = summary_of(out)
    assert summary["reference"] == "file"
    assert summary["index_sum"] == summary["winding_number"] == 1


@pytest.mark.full
def test_a_line_of_zeros_is_told(run, fields, tmp_path, capsys):
    out, command = tmp_path / "out", ("singularities", fields / "dense.safetensors")
    out.mkdir()
    (out / "zeros.csv").write_text("mine\n")
    assert run(*command, "--out", out, "--overwrite") == 0
    assert (out / "zeros.csv").read_text().startswith("x,y,")
    words = words_of(capsys.readouterr().out)
    assert "1 degenerate" in words
    assert "undecided places 1" in words
    summary = summary_of(out)
    assert summary["undecided_by_field"] == {"guiding": 0, "score": 1, "tangent": 0}
    assert summary["reference"] == "cloud"


def test_zeros_are_proved_on_request(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("singularities", fields / "learned.safetensors", "--prove", "--out", out) == 0
    words = words_of(capsys.readouterr().out)
    assert "proved of the tangent 1 enclosed, no others; winding number 1" in words
    proved = summary_of(out)["proved"]
    assert list(proved) == ["guiding", "score", "tangent"]
    for part in proved.values():
        assert part["complete"]
        assert part["undecided"] == 0
        assert part["winding_number"] == part["index_sum"]
        assert part["boxes"] > 1_000
    (zero,) = proved["tangent"]["zeros"]
    assert (zero["index"], zero["kind"], zero["stable"]) == (1, "focus", True)
    assert np.abs([zero["x"], zero["y"]]).max() <= zero["radius"] < 1e-9


def test_the_zeros_of_a_circle_in_space(run, fields, tmp_path, capsys, monkeypatch):
    # Its tangent vanishes along a line: more cubes than are affordable.
    monkeypatch.setattr("sgvf_drake.certificate.zeros.MOST_CUBES", 1_000)
    monkeypatch.setattr("sgvf_drake.certificate.zeros.FIRST", HALF_WIDTH / 8)
    out = tmp_path / "out"
    assert run("singularities", fields / "tilted.safetensors", "--prove", "--out", out) == 0
    words = words_of(capsys.readouterr().out)
    assert "guiding field 1 saddle left along a surface; indices sum up to -1 zeros" in words
    assert re.search(r"proved of the tangent 0 enclosed, \d+ cubes undecided", words)
    assert "winding" not in words
    summary, table = summary_of(out), pd.read_csv(out / "zeros.csv")
    assert summary["winding_number"] is None
    assert not summary["proved"]["tangent"]["complete"]
    assert names_in(out) == {"summary.json", "zeros.csv", "singularities.png"}
    assert np.allclose(table.loc[0, ["x", "y", "z"]].astype(float), 0, atol=1e-9)
    assert table.loc[0, "unstable_directions"] == 2
    assert table.loc[0, "eigenvalue_3_imag"] == summary["zeros"][0]["eigenvalues"][2][1]


# Bad input. A name ending in .safetensors or .json is that of a file of `fields`.

CHECK = ("--check", CERTIFICATE)
COLUMNS = "--columns x,y chooses columns of --reference; give both"
NO_FIELD = "broken.safetensors: not a whole safetensors file"
BAD = [
    ("verify", ("ring", "--starts", 0), "the number of starts must be at least 1, not 0"),
    ("verify", ("ring", "--fly", "--speed", -1), "speed must be a positive number, not -1.0"),
    ("verify", ("ring", "--scale", 0), "the scale must be a positive number, not 0.0"),
    ("verify", ("ring", "--columns", "x,y"), COLUMNS),
    ("verify", ("ring", "--reference", "no.csv"), "no.csv"),
    ("verify", ("broken",), NO_FIELD),
    ("verify", ("missing",), "missing.safetensors: no such file"),
    ("singularities", ("open", "--prove"), "zeros are enclosed of smooth fields of closed"),
    ("singularities", ("sparse", "--columns", "x,y"), COLUMNS),
    ("certify", ("stopping", *CHECK), "another field"),
    ("certify", ("ring", *CHECK, "--speed", 1.5, "--scale", 0.25), "another field"),
    ("certify", ("ring", "--check", "none.json"), "none.json"),
    ("certify", ("ring", *CHECK, "--levels"), "--check proves what the certificate holds"),
    (
        "certify",
        ("ring", "--route", "1"),
        "--route is for fields of paths that cross or branch",
    ),
    ("certify", ("open", "--levels"), "levels of V are proved of closed paths in the plane"),
    ("fly", ("stopping", "--certificate", CERTIFICATE), "the certificate of another field"),
    ("fly", ("ring", "--certificate", "."), "no certificate in ."),
    ("fly", ("ring", "--tour", "1,1", "--certificate", CERTIFICATE), "says nothing of a tour"),
]


@pytest.mark.parametrize(("command", "arguments", "words"), BAD, ids=[bad[2] for bad in BAD])
def test_bad_input_is_one_line(fields, tmp_path, refused, command, arguments, words):
    (name, *options), out = arguments, tmp_path / "out"
    field = fields / f"{name}.safetensors"
    assert words in refused(command, field, *options, "--out", out)
    assert not out.exists()


def test_a_changed_certificate_and_a_tube_that_is_none_are_refused(fields, tmp_path, refused):
    field, file = fields / "ring.safetensors", tmp_path / "changed.json"
    file.write_text(CERTIFICATE.read_text().replace('"boxes": ', '"boxes": 1'))
    line = refused("certify", field, "--check", file, "--out", tmp_path / "out")
    assert "changed.json" in line
    assert "was changed" in line
    line = refused("fly", field, "--html", "--tube", field, "--out", tmp_path / "out")
    assert "ring.safetensors: cannot be read" in line
