"""The command `certify` on fields of paths that cross or branch."""

import pytest

from sgvf_drake.certificate import NetworkCertificate
from sgvf_drake.paths.itinerary import successors
from tests.helpers import ink, names_in, summary_of


@pytest.fixture(scope="module")
def tee_file(tmp_path_factory, tee_field):
    file = tmp_path_factory.mktemp("network") / "tee.safetensors"
    tee_field.save(file)
    return file


@pytest.fixture(scope="module")
def route(tee_field):
    """Two edges that follow each other at the junction."""
    number, numbers = next(
        (number, numbers)
        for number, numbers in successors(tee_field.network).items()
        if len(numbers) == 2
    )
    return f"{number},{numbers[0]}"


def test_a_route_is_certified(run, tee_file, tee_field, route, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("certify", tee_file, f"--route={route}", "--out", out) == 0
    printed = capsys.readouterr().out
    assert "turns proved" in printed
    assert "9 of 9" in printed
    assert names_in(out) == {"summary.json", "certificate.json", "certificate.png"}
    assert ink(out / "certificate.png") > 0.01
    summary = summary_of(out)
    assert (summary["certified"], summary["checked"]) == (True, False)
    assert summary["route"]["edges"] == [int(number) for number in route.split(",")]
    assert 0 < summary["route"]["time_low"] < summary["route"]["time_high"]
    turns = {(own["from"], own["into"]) for own in summary["turns"] if own["proved"]}
    assert turns == {
        (number, after)
        for number, numbers in successors(tee_field.network).items()
        for after in numbers
    }
    assert len(summary["sections"]) == 6
    again = tmp_path / "again"
    file = out / "certificate.json"
    assert run("certify", tee_file, "--check", file, "--out", again) == 0
    assert summary_of(again)["checked"]
    assert NetworkCertificate.load(again / "certificate.json").certified


def test_what_is_not_proved_ends_in_status_1_and_is_told(
    run, tee_file, tee_field, tmp_path, capsys, monkeypatch
):
    """No tube is tried."""
    monkeypatch.setattr("sgvf_drake.certificate.leg_search.INFLOWS", ())
    out = tmp_path / "out"
    assert run("certify", tee_file, "--out", out) == 1
    summary = summary_of(out)
    assert not summary["certified"]
    failed = [own for own in summary["turns"] if not own["proved"]]
    assert failed
    assert all(own["reason"] and len(own["where"]) == 2 for own in failed)
    assert "Turns that are not proved" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--levels",), "--levels is not for fields of paths that cross or branch"),
        (("--speed", 1.0), "--speed is not for fields of paths that cross or branch"),
        (("--route", "1,7"), "there is no edge 7"),
        (("--check", "none.json"), "none.json"),
    ],
)
def test_bad_input_is_one_line(tee_file, refused, tmp_path, options, words):
    out = tmp_path / "out"
    assert words in refused("certify", tee_file, *options, "--out", out)
    assert not out.exists()
