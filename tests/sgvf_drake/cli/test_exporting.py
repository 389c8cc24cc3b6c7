"""The command `export`: what it leaves, what it prints, and what it says to bad input."""

import re

import numpy as np
import onnx
import pytest

from sgvf_drake.certificate import Certificate
from sgvf_drake.experiments import as_flown
from sgvf_drake.export import C_FILES
from sgvf_drake.export.onnx import Session
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths.itinerary import successors
from systems import FieldForSpeed
from tests.helpers import content_of, names_in, summary_of


def test_c_code(run, trained, flight_field, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("export", trained, "--to", "c", "--out", out) == 0
    assert names_in(out) == {"summary.json", *C_FILES}
    summary = summary_of(out)
    assert (summary["to"], summary["precision"]) == ("c", "mixed")
    assert summary["digest"] == field_digest(flight_field)
    assert f'"{summary["digest"]}"' in (out / "field.h").read_text()
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "field │ m(x) in 2-D │" in re.sub(" +", " ", shown.out)
    assert shown.out.endswith(f"results in {out}\n")


def test_as_it_is_flown_and_in_another_precision(run, trained, flight_field, tmp_path):
    arguments = ("export", trained, "--to", "c", "--out", tmp_path, "--speed", 2)
    assert run(*arguments, "--precision", "float") == 0
    flown = FieldForSpeed(flight_field, 2.0)
    assert flown.approach_length > flight_field.approach_length
    assert summary_of(tmp_path)["digest"] == field_digest(flown)
    header = (tmp_path / "field.h").read_text()
    assert f"FIELD_APPROACH_LENGTH {flown.approach_length!r}\n" in header
    assert 'FIELD_PRECISION "float"\n' in header


def test_routes(run, tee_field, tmp_path, capsys):
    file = tmp_path / "tee.safetensors"
    tee_field.save(file)
    network = tee_field.network
    first, second = (f"1,{after}" for after in successors(network)[1][:2])
    routes = ("--route", first, "--route", second)
    assert run("export", file, "--to", "c", *routes, "--out", tmp_path / "out") == 0
    assert summary_of(tmp_path / "out")["routes"] == [first, second]
    assert f"route 1 │ edges {second} " in re.sub(" +", " ", capsys.readouterr().out)


def test_results_are_replaced_only_when_asked(run, refused, trained, tmp_path):
    arguments = ("export", trained, "--to", "c", "--out", tmp_path)
    assert run(*arguments) == 0
    before = content_of(tmp_path)
    assert "already holds summary.json, field.h" in refused(*arguments, "--precision", "float")
    assert content_of(tmp_path) == before
    assert run(*arguments, "--precision", "float", "--overwrite") == 0
    assert summary_of(tmp_path)["precision"] == "float"


def test_graphs_of_a_field_as_it_is_flown(run, trained, tmp_path, capsys, flight_field):
    out = tmp_path / "out"
    arguments = ("export", trained, "--to", "onnx", "--speed", 0.45, "--out", out)
    assert run(*arguments, "--precision", "float") == 0
    assert names_in(out) == {"summary.json", "field.onnx", "field_jacobian.onnx"}
    summary = summary_of(out)
    assert (summary["to"], summary["precision"], summary["speed"]) == ("onnx", "float", 0.45)
    assert summary["files"]["field_jacobian.onnx"]["outputs"] == ["m", "jacobian"]
    flown = as_flown(flight_field, 0.45)
    x = flight_field.cloud.points[::20] + 0.05
    (m,) = Session(onnx.load(out / "field.onnx"))(x)
    np.testing.assert_allclose(m, flown(x), atol=1e-4)
    assert np.abs(m - flight_field(x)).max() > 0.01
    shown = capsys.readouterr().out
    assert "field_jacobian.onnx" in shown
    assert shown.endswith(f"results in {out}\n")
    # Nothing is replaced unless it is asked for.
    assert run(*arguments) == 2
    assert run(*arguments, "--overwrite") == 0
    assert summary_of(out)["precision"] == "double"


def test_a_certificate_that_says_nothing_of_the_export_is_told(
    run, trained, tmp_path, capsys, flight_field
):
    certificate = Certificate(
        certified=True, reason="", field_digest=field_digest(flight_field)
    )
    certificate.save(tmp_path / "certificate.json")
    options = ("export", trained, "--to", "onnx", "--certificate", tmp_path, "--precision")
    assert run(*options, "int8", "--out", tmp_path / "out") == 1
    told = "nothing bounds the errors of int8"
    assert told in capsys.readouterr().out.replace("\n", " ")
    assert told in summary_of(tmp_path / "out")["certificate"]["reason"]
    (note,) = (
        part.value
        for part in onnx.load(tmp_path / "out" / "field.onnx").metadata_props
        if part.key == "certificate"
    )
    assert told in note
    # Its score is the closed form.
    assert run(*options, "float", "--out", tmp_path / "float") == 2
    assert "closed-form score" in capsys.readouterr().err
    assert names_in(tmp_path) == {"certificate.json", "out"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--to", "fortran"), "--to cannot be 'fortran'; it is one of c, onnx"),
        (("--to", "c", "--precision", "half"), "precision cannot be 'half'"),
        (("--to", "c", "--route", "1"), "the field is no directed one; it has no routes"),
        (("--to", "onnx", "--precision", "half"), "--precision cannot be 'half'"),
        (("--to", "onnx", "--route", "1"), "--route is for --to c"),
    ],
)
def test_bad_options(refused, trained, tmp_path, options, message):
    out = tmp_path / "out"
    assert message in refused("export", trained, *options, "--out", out)
    assert not out.exists()
