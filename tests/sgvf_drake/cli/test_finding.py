"""The command `paths`: what it leaves, what it says, bad input."""

import json

import numpy as np
import pytest

from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths import PathNetwork
from tests.helpers import ink, names_in, summary_of
from tests.networks import SHAPES, straight_network, topology

FILES = {"summary.json", "network.json", "network.png"}
KEYS = {
    *("pieces", "nodes", "edges", "junctions", "crossings", "ends", "cycles", "length", "unit"),
    *("scatter", "sigma", "spacing", "dropped", "cpu_s", "unsure", "messages"),
}


@pytest.fixture
def cloud(tmp_path):
    """Makes a file of one of the known shapes."""

    def make(name, count=300):
        points = SHAPES[name].sample(count, 0.02, random=False, seed=0)
        path = tmp_path / "points.csv"
        header = ",".join("xyz"[: points.shape[1]])
        np.savetxt(path, points, delimiter=",", header=header, comments="")
        return path

    return make


def test_a_network(run, cloud, tmp_path, capsys):
    out = tmp_path / "out"
    run("paths", cloud("roundabout"), "--out", out)
    said = capsys.readouterr().out
    assert "points.csv: CSV, 300 points" in said
    assert "piece 1: network" in said
    assert "3 junctions, 3 ends" in said
    assert names_in(out) == FILES
    summary = summary_of(out)
    assert summary.keys() >= KEYS
    assert (summary["junctions"], summary["crossings"], summary["ends"]) == (3, 0, 3)
    assert (len(summary["pieces"]), len(summary["nodes"]), len(summary["edges"])) == (1, 6, 6)
    assert summary["cycles"] == 6 - 6 + 1
    lengths = [edge["length"] for edge in summary["edges"]]
    assert summary["length"] == pytest.approx(sum(lengths))
    assert summary["unsure"] is None
    for piece, found in enumerate(summary["pieces"]):
        for name in ("nodes", "edges"):
            own = [k for k, one in enumerate(summary[name]) if one["piece"] == piece]
            assert found[name] == own
    network = PathNetwork.load(out / "network.json")
    assert topology(network) == SHAPES["roundabout"].topologies[0]
    assert [edge.length for edge in network.edges] == pytest.approx(lengths)
    assert 0.005 < ink(out / "network.png") < 0.5


def test_a_plain_loop_in_space_counts_one_cycle(run, cloud, tmp_path):
    run("paths", cloud("trefoil in space"), "--out", tmp_path / "out")
    summary = summary_of(tmp_path / "out")
    assert (summary["cycles"], summary["nodes"], summary["dim"]) == (1, [], 3)
    assert [edge["nodes"] for edge in summary["edges"]] == [None]


def test_options_and_bad_input(run, refused, cloud, tmp_path):
    path, out = cloud("circle"), tmp_path / "out"
    run("paths", path, "--open", "--start", "4,0", "--out", out)
    (piece,) = summary_of(out)["pieces"]
    assert piece["kind"] == "open path"
    run("paths", path, "--passes", "--sigma", "0.3", "--out", out, "--overwrite")
    (piece,) = summary_of(out)["pieces"]
    assert piece["kind"] == "closed path"
    assert "already holds" in refused("paths", path, "--out", out)
    for options, message in (
        (["--sigma", "-1"], "--sigma must be a positive length"),
        (["--direction", "up"], "--direction cannot be 'up'"),
        (["--direction", "cw,cw"], "2 entries, but the path has 1 piece"),
        (["--start", "1,2,3"], "start has 3 coordinates"),
        (["--columns", "a,b"], "there is no column 'a'"),
    ):
        assert message in refused("paths", path, *options, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_clouds_that_no_path_fits_are_refused_with_the_name_of_their_file(refused, tmp_path):
    grid = "".join(f"{n % 10},{n // 10}\n" for n in range(50))
    for content in (
        "x,y\n1e308,1e308\n-1e308,-1e308\n0,1e308\n",
        f"x,y\n{grid}1e90,0\n",
    ):
        path = tmp_path / "odd.csv"
        path.write_text(content)
        assert "odd.csv: " in refused("paths", path, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_damaged_network_is_one_error(tmp_path):
    for text in (
        "",
        "{",
        "[]",
        "{}",
        json.dumps({"format": "sgvf-path-network", "version": 1}),
    ):
        path = tmp_path / "network.json"
        path.write_text(text)
        with pytest.raises(ValueError, match=r"network\.json"):
            PathNetwork.load(path)


def test_a_network_of_another_version_is_refused():
    data = straight_network(np.array([[0.0, 0.0], [4.0, 0.0]]), [(0, 1)]).to_json()
    assert PathNetwork.from_json(data).to_json() == data
    for name, other in (("version", data["version"] + 1), ("format", "another")):
        with pytest.raises(PointCloudError, match=f"no {data['format']} of version"):
            PathNetwork.from_json(data | {name: other})
