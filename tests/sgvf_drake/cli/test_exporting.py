"""The command `export`: what it leaves, what it prints, and what it says to bad input."""

import numpy as np
import onnx
import pytest

from sgvf_drake.certificate import Certificate
from sgvf_drake.experiments import as_flown
from sgvf_drake.export.onnx import Session
from sgvf_drake.fields.storage import field_digest
from tests.helpers import names_in, summary_of


def test_a_field_as_it_is_flown(run, trained, tmp_path, capsys, flight_field):
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


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--to", "matlab"], "--to cannot be 'matlab'; it is one of onnx"),
        (["--to", "onnx", "--precision", "half"], "--precision cannot be 'half'"),
    ],
)
def test_bad_input(refused, trained, tmp_path, options, expected):
    assert expected in refused("export", trained, *options, "--out", tmp_path / "out")
    assert names_in(tmp_path) == set()


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
