"""The command `fly`: tours, sensors, recordings and the live view, and what it refuses."""

from dataclasses import asdict
import json
import math
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.cli.tables import print_live
from systems import DISTURBANCE_BANDWIDTH, Change, Disturbance, Mode, SensorParameters
from tests.fields import exact_field as exact_field_at
from tests.fields import linear_network
from tests.helpers import circle, ink, names_in, summary_of

# The circles have radii of 2 and 4 units of the waypoints; in m a unit and m/s.
SCALE, SPEED = 0.25, 1.5


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, exact_field):
    """A field of two circles, a path along one of them, and results of verifications."""
    folder = tmp_path_factory.mktemp("inputs")
    field = exact_field
    field.save(folder / "field.safetensors")
    inner = min(np.hypot(*field.cloud.points.T))
    closed = circle(inner, 200)[np.arange(201) % 200]
    np.savetxt(folder / "circle.csv", closed, delimiter=",")
    summary = {"digest": field.cloud.digest, "recipe": field.recipe, "seed": field.seed}
    unit = field.cloud.unit_length
    summary |= {"c_in": 0.5, "sigma": 0.3 * unit, "unit_length": unit}
    for name, changes in {
        "verified": {},
        "other": {"digest": "0"},
        "no_tube": {"c_in": None},
    }.items():
        (folder / name).mkdir()
        (folder / name / "summary.json").write_text(json.dumps(summary | changes))
    return folder


@pytest.fixture(scope="module")
def toured(run, inputs, tmp_path_factory):
    """The folder of a tour with everything."""
    out = tmp_path_factory.mktemp("tour") / "deep" / "out"
    options = ("--tour", "2,1", "--scale", SCALE, "--speed", SPEED, "--sensors", "--seed", 5)
    shown = ("--html", "--tube", inputs / "verified")
    assert run("fly", inputs / "field.safetensors", *options, *shown, "--out", out) == 0
    return out


def test_a_tour_leaves_its_results(toured):
    assert names_in(toured) == {"summary.json", "tour.html", "tour.parquet", "tour.png"}
    summary, log = summary_of(toured), pd.read_parquet(toured / "tour.parquet")
    assert summary["completed"] is True
    assert [leg["piece"] for leg in summary["legs"]] == [1, 0]
    assert [transfer["piece"] for transfer in summary["transfers"]] == [0]
    assert summary["speed_command_m_s"] == SPEED
    assert summary["reference"] == "shape"
    assert summary["sensors"] == {**asdict(SensorParameters()), "seed": 5}
    assert summary["duration_s"] == log["time"].iloc[-1]
    radius = np.hypot(log["x"], log["y"])
    for piece, expected in ((1, 4.0), (0, 2.0)):
        rows = (log["mode"] == Mode.FOLLOW) & (log["piece"] == piece)
        assert radius[rows].iloc[-1] == pytest.approx(SCALE * expected, abs=0.05)
    assert 0.005 < ink(toured / "tour.png") < 0.9


def test_a_tour_is_replaced_when_asked_and_prints_its_parts(
    run, inputs, toured, tmp_path, capsys
):
    out = tmp_path / "out"
    shutil.copytree(toured, out)
    options = ("--tour", "1", "--scale", SCALE, "--speed", 2.0, "--laps", 2, "--overwrite")
    assert run("fly", inputs / "field.safetensors", *options, "--out", out) == 0
    printed = capsys.readouterr()
    for words in ("Tour", "along piece 1", "RMS [m]", "force [N]", "results in"):
        assert words in printed.out
    assert printed.err == ""
    # The page of the tour before is gone.
    assert names_in(out) == {"summary.json", "tour.parquet", "tour.png"}
    summary = summary_of(out)
    assert [leg["piece"] for leg in summary["legs"]] == [0]
    assert summary["sensors"] is None
    assert summary["disturbance"] is None
    assert summary["duration_s"] >= 0.98 * 2 * 2 * np.pi * (2.0 * SCALE) / 2.0


@pytest.mark.parametrize(
    ("heading", "told", "yaw"),
    [
        ("path", "path", lambda log: np.arctan2(log.vy, log.vx)),
        ("0.2,0.1", [0.2 * SCALE, 0.1 * SCALE], None),
        ("-90", -math.pi / 2, lambda log: -math.pi / 2),
    ],
)
def test_the_vehicle_looks_where_it_is_told_to(run, inputs, tmp_path, heading, told, yaw):
    flight = ("fly", inputs / "field.safetensors", "--scale", SCALE, "--speed", 0.5)
    assert run(*flight, "--tour", 1, "--heading", heading, "--out", tmp_path / "out") == 0
    assert summary_of(tmp_path / "out")["heading"] == told
    log = pd.read_parquet(tmp_path / "out" / "tour.parquet")
    log = log[log.time > 2.0]
    wanted = yaw(log) if yaw else np.arctan2(told[1] - log.y, told[0] - log.x)
    turn = np.angle(np.exp(1j * (log.yaw - wanted)))
    # A heading that turns is followed 2 damping_ratio / attitude_bandwidth = 0.12 s later.
    assert np.abs(turn).max() < 0.15


def test_wind_drifts_a_flight_unless_it_is_made_up_for(run, inputs, tmp_path):
    options = ("--tour", "1", "--scale", SCALE, "--speed", 0.5, "--wind", "2,0", "--gust", 0.1)
    errors = []
    for name, more in (("drifts", ()), ("keeps", ("--compensate",))):
        flight = ("fly", inputs / "field.safetensors", *options, *more)
        assert run(*flight, "--seed", 3, "--out", tmp_path / name) == 0
        summary = summary_of(tmp_path / name)
        air = Disturbance(wind=(2.0, 0.0, 0.0), gust=0.1)
        assert summary["disturbance"] == {
            **asdict(air),
            "wind": [2.0, 0.0, 0.0],
            "disturbance_bandwidth": DISTURBANCE_BANDWIDTH if more else 0.0,
            "seed": 3,
        }
        errors.append(summary["legs"][0]["cross_track_rms_m"])
    assert errors[0] > 3.0 * errors[1]


def test_a_flight_leaves_a_page_and_can_be_watched_live(run, inputs, tmp_path, capsys):
    # So small and fast that it is over in two seconds of the clock.
    options = ("--scale", SCALE / 2, "--speed", 2.0, "--laps", 1, "--meshcat", "--html")
    options += ("--wind", "0,0")
    path = ("--reference", inputs / "circle.csv")
    out = tmp_path / "out"
    assert run("fly", inputs / "field.safetensors", *options, *path, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "watch it at http://localhost:" in printed
    files = [f"flight_1.{kind}" for kind in ("html", "parquet", "png")]
    assert names_in(out) == {*files, "summary.json"}
    assert "<html" in (out / "flight_1.html").read_text()
    summary = summary_of(out)
    assert summary["reference"] == "file"
    untouched = {"changes": [], "stopped": False, "lost_control": None}
    assert summary["pieces"][0]["live"] == untouched
    log = pd.read_parquet(out / "flight_1.parquet")
    assert (log["live_speed"] == 2.0).all()
    # Air that a slider could move, which nobody did.
    assert (log["live_wind_x"] == 0.0).all()


def test_what_was_changed_in_flight_is_told_in_a_line_each(capsys):
    faster = Change(3.2, "speed", 0.45, 0.8, "m/s")._asdict()
    blown = Change(4.0, "wind_x", 0.0, -2.0, "m/s")._asdict()
    ends = {"stopped": False, "lost_control": None}
    first = {"changes": [faster, blown], **ends, "stopped": True}
    second = {"changes": [faster], **ends, "lost_control": "t = 4.1 s: [nan]"}
    lines = ("t = 3.2 s: speed 0.45 -> 0.8 m/s", "t = 4.0 s: wind x 0 -> -2 m/s")
    print_live({"live": first})
    assert capsys.readouterr().out.splitlines() == [*lines, "stopped by its button"]
    print_live({"pieces": [{"live": first}, {"live": second}]})
    printed = capsys.readouterr()
    assert f"flight 2, {lines[0]}" in printed.out.splitlines()
    told = "warning: flight 2, the vehicle lost control at t = 4.1 s: [nan]"
    assert printed.err.splitlines() == [told]
    print_live({"routes": [{"live": None}]})
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("height", "scale", "lowest"),
    [(1.0, 1.0, None), (0.0, 1.0, "0"), (-5.0, 2.0, "-10"), (0.1, 1.0, None)],
)
def test_nothing_is_flown_at_the_ground_or_below_in_silence(
    run, tmp_path, capsys, height, scale, lowest
):
    points = np.column_stack([circle(4.0, 60), np.full(60, height)])
    turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    tangent = linear_network(turn, point=(0.0, 0.0, 0.0))
    exact_field_at(points, tangent=tangent).save(tmp_path / "field.safetensors")
    # It is refused after the warning, before anything flies.
    options = ("--scale", scale, "--tube", tmp_path, "--out", tmp_path / "out")
    assert run("fly", tmp_path / "field.safetensors", *options) == 2
    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    expected = f"warning: the path goes down to z = {lowest} m; the ground is at 0"
    assert warnings == ([] if lowest is None else [expected])


@pytest.mark.parametrize(
    ("vehicle", "scale", "options"),
    [
        ("unicycle", SCALE, ("--turn-radius", 0.3)),
        ("fixed-wing", 10.0, ("--turn-radius", 8, "--wind", "5,0")),
    ],
)
def test_a_vehicle_is_chosen_by_its_name(
    run, inputs, tmp_path, capsys, vehicle, scale, options
):
    out = tmp_path / "out"
    path = ("--reference", inputs / "circle.csv", "--scale", scale, "--laps", 1)
    flight = ("fly", inputs / "field.safetensors", *path, "--vehicle", vehicle, *options)
    assert run(*flight, "--out", out) == 0
    printed = capsys.readouterr().out
    assert re.search(r"curvature \S+ of \S+ 1/m: feasible", printed)
    assert names_in(out) == {"flight_1.parquet", "flight_1.png", "summary.json"}
    summary, log = summary_of(out), pd.read_parquet(out / "flight_1.parquet")
    assert summary["vehicle"] == vehicle
    assert summary["speed_command_m_s"] == {"unicycle": 0.45, "fixed-wing": 15.0}[vehicle]
    assert summary["cross_track_rms_m"] < 0.02 * scale
    assert "heading" in log
    assert summary["heading"] is None
    assert 0.005 < ink(out / "flight_1.png") < 0.9


BAD = {
    "unknown piece": (("--tour", "1,3"), "no piece 3 to fly (there are 1, 2)"),
    "no list": (("--tour", "1,two"), "--tour 1,two is no list of pieces, as 1,2,1 is"),
    "empty list, live": (("--tour", "", "--meshcat"), "is no list of pieces"),
    "half a lap": (("--tour", "1,2", "--laps", 0.5), "laps must be at least 1, not 0.5"),
    "another path": (
        ("--tour", "1", "--reference", "{inputs}/circle.csv"),
        "the waypoints are in 2 pieces, which are not those of the reference",
    ),
    "nowhere to look": (
        ("--heading", "north"),
        "--heading north is none, as path, 90 or the point 3.5,-2 is",
    ),
    "hidden tube": (("--tube", "{inputs}/verified"), "is shown by --html or --meshcat"),
    "another tube": (
        ("--meshcat", "--tube", "{inputs}/other"),
        "other is the verification of another field",
    ),
    "no vehicle": (("--vehicle", "boat"), "there is no vehicle 'boat'; there are quadrotor"),
    "wind on the ground": (
        ("--vehicle", "unicycle", "--wind", "1,0"),
        "a unicycle stands on the ground: no wind moves it",
    ),
    "wind too strong": (
        ("--vehicle", "fixed-wing", "--scale", 50, "--wind", "16,0"),
        "wind of 16 m/s blows a fixed wing away that flies at 15 m/s",
    ),
    "too small a path": (
        ("--vehicle", "fixed-wing"),
        "a fixed wing with a turn radius of 32.8 m cannot follow the path",
    ),
    "a tour that turns": (("--vehicle", "unicycle", "--tour", "1"), "can neither slow down"),
    "sensors that turn": (("--vehicle", "unicycle", "--sensors"), "those of a quadrotor"),
    "nothing to make up for": (("--vehicle", "unicycle", "--compensate"), "no gains to set"),
    "a page that turns": (
        ("--vehicle", "unicycle", "--html"),
        "--html is for quadrotors only, no unicycle",
    ),
    "a heading that turns": (
        ("--vehicle", "unicycle", "--heading", "path"),
        "--heading is for quadrotors only, no unicycle",
    ),
    "a quadrotor that turns": (("--turn-radius", 1), "it has no turn radius to choose"),
    "no tube": (("--html", "--tube", "{inputs}/no_tube"), "no_tube found no tube"),
}


@pytest.mark.parametrize(("options", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line(inputs, tmp_path, refused, options, words):
    filled = [str(option).format(inputs=inputs) for option in options]
    out = tmp_path / "deep" / "out"
    assert words in refused("fly", inputs / "field.safetensors", *filled, "--out", out)
    assert names_in(tmp_path) == set()


# On fields of paths that cross or branch.

ABOVE = np.array([0.0, 0.6])


@pytest.fixture(scope="module")
def network_file(tmp_path_factory, tee_field):
    """A file with the directed field of a T, in units of half a metre."""
    file = tmp_path_factory.mktemp("network") / "tee.safetensors"
    tee_field.rescaled(2.0).save(file)
    return file


def test_a_route_leaves_its_results(run, network_file, tee_field, tmp_path, capsys):
    # From one side of the bar, past the junction, to the end of the stem.
    network = tee_field.network
    start = next(k for k, edge in enumerate(network.edges, 1) if edge.line.vertices[0, 0] < -1)
    stem = next(
        k * (1 if edge.line.vertices[-1, 1] < -1 else -1)
        for k, edge in enumerate(network.edges, 1)
        if edge.line.vertices[:, 1].min() < -1
    )
    options = ("--route", f"{start},{stem}", "--scale", 0.5, "--speed", 1.0, "--html")
    out = tmp_path / "out"
    assert run("fly", network_file, *options, "--out", out) == 0
    assert "turns" in capsys.readouterr().out
    assert names_in(out) == {"summary.json", "route.html", "route.parquet", "route.png"}
    summary, log = summary_of(out), pd.read_parquet(out / "route.parquet")
    assert summary["route"] == [start, stem]
    assert summary["route_completed"] is True
    assert summary["turn_fraction"] in (1.0, None)
    assert summary["reference"] == "network"
    assert summary["speed_command_m_s"] == 1.0
    end = network.edges[abs(stem) - 1].line.vertices[-1 if stem > 0 else 0]
    np.testing.assert_allclose(log[["x", "y"]].iloc[-1], end, atol=0.1)
    assert 0.005 < ink(out / "route.png") < 0.9


def test_a_point_is_flown_to_in_the_unit_of_the_waypoints(
    run, network_file, tee_field, tmp_path
):
    stem = min((node.place for node in tee_field.network.nodes), key=lambda place: place[1])
    target = ",".join(str(x) for x in 2.0 * (stem + ABOVE))
    options = (f"--to={target}", "--scale", 0.5, "--speed", 1.0)
    out = tmp_path / "out"
    assert run("fly", network_file, *options, "--out", out) == 0
    log = pd.read_parquet(out / "route.parquet")
    np.testing.assert_allclose(log[["x", "y"]].iloc[-1], stem + ABOVE, atol=0.1)


BAD_ROUTES = {
    "unknown edge": (("--route", "1,9"), "there is no edge 9 (there are 1 to 3)"),
    "no list": (("--route", "1,two"), "'1,two' is no list of edges, as 1,2,-3 is"),
    "two at once": (("--route", "1", "--cover"), "--route and --cover exclude each other"),
    "tour too": (("--tour", "1", "--to", "0,0"), "--tour and --to exclude each other"),
    "no point": (("--to", "1,here"), "--to 1,here is no point, as 3.5,-2 is"),
    "flat point": (("--to", "1"), "is no point in 2 dimensions"),
    "another path": (
        ("--reference", "{inputs}/circle.csv"),
        "measured against its own network",
    ),
    "a tube": (("--html", "--tube", "{inputs}/verified"), "of the position alone"),
    "half a lap": (("--cover", "--laps", 0.5), "laps must be at least 1, not 0.5"),
}


@pytest.mark.parametrize(("options", "words"), BAD_ROUTES.values(), ids=BAD_ROUTES)
def test_a_bad_route_is_one_line(network_file, inputs, tmp_path, refused, options, words):
    filled = [str(option).format(inputs=inputs) for option in options]
    out = tmp_path / "deep" / "out"
    assert words in refused("fly", network_file, *filled, "--out", out)
    assert names_in(tmp_path) == set()


@pytest.mark.parametrize("option", [("--route", "1"), ("--to", "1,2"), ("--cover",)])
def test_a_field_of_the_position_alone_has_no_routes(inputs, tmp_path, refused, option):
    line = refused("fly", inputs / "field.safetensors", *option, "--out", tmp_path / "out")
    assert "are for fields of paths that cross or branch" in line
