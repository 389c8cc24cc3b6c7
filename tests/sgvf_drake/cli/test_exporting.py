"""The command `export`: what it leaves, what it prints, and what it says to bad input."""

import re

import pytest

from sgvf_drake.export import C_FILES
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths.itinerary import successors
from systems import FieldForSpeed
from tests.helpers import content_of, names_in, summary_of


def test_c_code(run, trained, flight_field, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("export", trained, "--to", "c", "--out", out) == 0
    assert names_in(out) == {"summary.json", *C_FILES}
    summary = summary_of(out)
    assert (summary["target"], summary["precision"]) == ("c", "mixed")
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--to", "fortran"), "--to cannot be 'fortran'; it is one of c"),
        (("--to", "c", "--precision", "half"), "precision cannot be 'half'"),
        (("--to", "c", "--route", "1"), "the field is no directed one; it has no routes"),
    ],
)
def test_bad_options(refused, trained, tmp_path, options, message):
    out = tmp_path / "out"
    assert message in refused("export", trained, *options, "--out", out)
    assert not out.exists()
