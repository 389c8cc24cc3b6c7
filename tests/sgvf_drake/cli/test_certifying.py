"""The command `certify`: what it prints and leaves, its exit status, what it refuses."""

from dataclasses import replace
import json

import numpy as np
import pytest

from sgvf_drake.fields import GaussianMixture, Perceptron
from sgvf_drake.paths import PointCloud

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@pytest.fixture(scope="module")
def fields(tmp_path_factory, make_field):
    """Files of a ring that can be followed, of one with a sink, and of one in space."""
    folder = tmp_path_factory.mktemp("fields")
    angles = 2 * np.pi * np.arange(80) / 80
    cloud = PointCloud(4 * np.column_stack([np.cos(angles), np.sin(angles)]))
    good = replace(
        make_field("exact", sigma=0.4, gain=0.8),
        cloud=cloud,
        sigma=0.4,
        score_model=GaussianMixture(cloud.normalize(cloud.points), 0.4),
        tangent_network=Perceptron((TURN,), (np.zeros(2),)),
    )
    sink = replace(
        good, tangent_network=Perceptron((np.array([[1.0, 0.0], [0.0, 0.0]]),), (np.zeros(2),))
    )
    space = make_field("robust", dim=3)
    space = replace(space, cloud=PointCloud(space.cloud.points))
    for name, field in (("good", good), ("sink", sink), ("space", space)):
        field.save(folder / f"{name}.safetensors")
    return folder


@pytest.fixture(scope="module")
def certified(run, fields, tmp_path_factory):
    """The folder of a certificate."""
    out = tmp_path_factory.mktemp("certificate") / "out"
    assert run("certify", fields / "good.safetensors", "--out", out) == 0
    return out


KEYS = {
    *("certified", "reason", "sigma", "c_in", "c_out", "alpha", "delta", "tube_half_width"),
    *("area_fraction", "decrease_fraction", "boxes", "time_s", "entry_time_bound"),
    *("e_star_max", "counterexample", "pieces"),
}


def test_what_it_leaves(certified):
    assert {path.name for path in certified.iterdir()} == {
        *("summary.json", "certificate.json", "certificate.png")
    }
    summary = json.loads((certified / "summary.json").read_text())
    assert set(summary) >= KEYS
    assert summary["certified"] is True
    assert summary["checked"] is False
    (piece,) = summary["pieces"]
    assert piece["holes"] == 1
    assert piece["orbit_exists"] is True
    assert piece["lap_time_low"] < 8 * np.pi < piece["lap_time_high"]


FLIGHT = ("--scale", 0.1, "--speed", 1.5, "--laps", 1)


def test_a_flight_is_held_against_the_certificate(run, fields, certified, tmp_path, capsys):
    out = tmp_path / "out"
    field = fields / "good.safetensors"
    assert run("fly", field, *FLIGHT, "--html", "--certificate", certified, "--out", out) == 0
    assert {path.name for path in out.iterdir()} == {
        *("summary.json", "certificate.png", "flight_1.html", "flight_1.parquet"),
        "flight_1.png",
    }
    found = json.loads((out / "summary.json").read_text())["certificate"]
    claimed = json.loads((certified / "summary.json").read_text())
    assert (found["c_in"], found["e_star_max"]) == (claimed["c_in"], claimed["e_star_max"])
    assert len(found["what_it_does_not_cover"]) > 3
    # So fast, it flies a wider field than the one that is certified.
    assert found["inside_margin"] is False
    printed = " ".join(capsys.readouterr().out.split())
    assert "NOT inside of the margin" in printed
    # Without a certificate, its figure does not stay.
    assert run("fly", field, *FLIGHT, "--overwrite", "--out", out) == 0
    assert "certificate" not in json.loads((out / "summary.json").read_text())
    assert not (out / "certificate.png").exists()


def test_flights_refuse_what_is_no_certificate_of_theirs(refused, fields, certified, tmp_path):
    field, out = fields / "good.safetensors", ("--out", tmp_path / "out")
    line = refused("fly", fields / "sink.safetensors", "--certificate", certified, *out)
    assert "is the certificate of another field" in line
    line = refused("fly", field, "--certificate", tmp_path, *out)
    assert f"no certificate in {tmp_path}" in line
    options = ("--tour", "1,1", "--certificate", certified)
    assert "says nothing of a tour" in refused("fly", field, *options, *out)
    line = refused("fly", field, "--html", "--tube", fields / "good.safetensors", *out)
    assert "good.safetensors: cannot be read" in line
    assert not (tmp_path / "out").exists()


def test_the_field_as_it_is_flown_is_another_one(refused, fields, certified, tmp_path):
    options = ("--speed", 1.5, "--scale", 0.25, "--check", certified / "certificate.json")
    line = refused("certify", fields / "good.safetensors", *options, "--out", tmp_path / "out")
    assert "another field" in line


def test_a_certificate_is_proved_anew(run, fields, certified, tmp_path, capsys):
    file = certified / "certificate.json"
    field = fields / "good.safetensors"
    assert run("certify", field, "--check", file, "--out", tmp_path / "again") == 0
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "certified yes" in printed
    first, again = (
        json.loads((folder / "summary.json").read_text())
        for folder in (certified, tmp_path / "again")
    )
    assert again["checked"] is True
    assert again["alpha"] == first["alpha"]
    assert (tmp_path / "again" / "certificate.json").read_text() == file.read_text()


def test_a_sink_ends_in_status_1_and_a_summary(run, fields, tmp_path, capsys):
    assert run("certify", fields / "sink.safetensors", "--out", tmp_path / "out") == 1
    assert "certified NO" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["certified"] is False
    x, y = summary["counterexample"]
    assert abs(x) < 0.1
    assert abs(abs(y) - 4) < 0.3


def test_bad_input(refused, fields, certified, tmp_path):
    field, out = fields / "good.safetensors", tmp_path / "out"
    assert "planar" in refused("certify", fields / "space.safetensors", "--out", out)
    file = tmp_path / "changed.json"
    text = (certified / "certificate.json").read_text()
    file.write_text(text.replace('"boxes": ', '"boxes": 1'))
    line = refused("certify", field, "--check", file, "--out", out)
    assert "changed.json" in line
    assert "was changed" in line
    claimed = certified / "certificate.json"
    other = fields / "sink.safetensors"
    assert "another field" in refused("certify", other, "--check", claimed, "--out", out)
    missing = tmp_path / "none.json"
    assert "none.json" in refused("certify", field, "--check", missing, "--out", out)
    assert not out.exists()
