"""Files of waypoints at the command line: what was read is told, and kept with the field."""

from dataclasses import replace
import json

import numpy as np

from sgvf_drake import PointCloud, experiments, load_field
from sgvf_drake.exceptions import ConfigurationError

FAST = ("--recipe", "exact", "--tangent-iterations", 20, "--max-restarts", 0)
TOLD = "lat, lon to metres east, north about 48.13720 N, 11.57560 E, 80 m x 40 m"


def test_a_field_of_degrees_keeps_their_origin(run, refused, tmp_path, capsys):
    angle = 2 * np.pi * np.arange(60) / 60
    latitude = 48.1372 + 20 / 111_208 * np.sin(angle)
    longitude = 11.5756 + 40 / 74_420 * np.cos(angle)
    rows = [f"{a:.8f},{b:.8f}" for a, b in zip(latitude, longitude, strict=True)]
    (tmp_path / "gps.csv").write_text("\n".join(["lat,lon", *rows]))
    # Half of the lap, whose middle is another one.
    (tmp_path / "half.csv").write_text("\n".join(["lat,lon", *rows[:31]]))
    out = tmp_path / "train"
    assert run("train", "--points", tmp_path / "gps.csv", *FAST, "--out", out) == 0
    said = f"gps.csv: CSV, 60 points, {TOLD}"
    assert capsys.readouterr().out.splitlines()[0] == said
    summary = json.loads((out / "summary.json").read_text())
    lap = "piece 1: closed path, length 193.7"
    order = "the order of the points gives the direction of travel"
    assert summary["messages"] == [said, lap, order]
    assert summary["origin"] == [48.1372, 11.5756, 0.0]
    assert load_field(out / "field.safetensors").cloud.origin == (48.1372, 11.5756, 0.0)
    options = ("--starts", 4, "--duration", 1, "--out", tmp_path / "follow")
    assert run("follow", out, "--reference", tmp_path / "half.csv", *options) == 0
    said = (
        "half.csv: CSV, 31 points, lat, lon to metres east, north about 48.13720 N, 11.57560 E"
    )
    assert capsys.readouterr().out.startswith(said)
    # Degrees say nothing to a field that was trained on none.
    (tmp_path / "x.csv").write_text("x,y\n" + "\n".join(rows))
    out = tmp_path / "plain"
    assert run("train", "--points", tmp_path / "x.csv", *FAST, "--out", out) == 0
    capsys.readouterr()
    options = ("--reference", tmp_path / "gps.csv", "--out", tmp_path / "not")
    assert "the reference is in degrees, but the field's" in refused("follow", out, *options)


def test_flights_warn_of_the_ground_and_of_blurred_pages(
    run, tmp_path, capsys, monkeypatch, make_field
):
    def stop(*arguments, **options):
        raise ConfigurationError("flown")

    monkeypatch.setattr(experiments, "run_fly", stop)
    field = make_field("exact", 3)
    low = "warning: the path goes down to z = -4 m; the ground is at 0"
    blurred = "warning: browsers resolve 0.64 m at coordinates of 5.4e+06 m; subtract an offset"
    height = float(field.cloud.points[:, 2].min())
    for offset, warnings in (
        ([0, 0, 0], []),
        ([0, 0, -4 - height], [low]),
        ([5e5, 5.4e6, 0], [blurred]),
    ):
        moved = PointCloud(field.cloud.points + offset)
        replace(field, cloud=moved).save(tmp_path / "field.safetensors")
        arguments = ("fly", tmp_path / "field.safetensors", "--html", "--out", tmp_path / "out")
        assert run(*arguments) == 2
        *told, error = capsys.readouterr().err.splitlines()
        assert error == "error: flown"
        assert len(told) == len(warnings)
        for line, warning in zip(told, warnings, strict=True):
            assert line.startswith(warning)
        (tmp_path / "field.safetensors").unlink()
