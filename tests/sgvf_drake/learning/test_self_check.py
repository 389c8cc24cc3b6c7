"""The self-check lets pass what can be followed, and names what is wrong with the rest."""

from dataclasses import dataclass, field, replace
from functools import cache
import json
import re

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.learning import SelfCheck, check_field
from sgvf_drake.learning.self_check import STARTS, STARTS_AROUND, Fault, PieceCheck
from sgvf_drake.paths import ReferencePath, make_shape
from sgvf_drake.paths.finding import find_paths

ALL = STARTS + STARTS_AROUND
# Of one cloud, the network is the same for all fields.
network_of = cache(find_paths)


def kinds(piece):
    return {fault.kind for fault in piece.faults}


@dataclass
class Stand:
    """What the self-check asks of a field: a cloud, a noise level, and a value."""

    cloud: PointCloud
    value: object
    sigma: float = 0.1
    ends: object = field(default_factory=lambda: np.empty((0, 2)))

    def __call__(self, x):
        return self.value(x)

    @property
    def network(self):
        return network_of(self.cloud)


def around(*radii, sign=1.0):
    """Counter-clockwise at unit speed on the nearest of concentric circles."""

    def value(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        nearest = np.array(radii)[np.abs(r - np.array(radii)).argmin(axis=1)][:, None]
        tangent = np.column_stack([-x[:, 1], x[:, 0]]) / r
        return sign * tangent + 2 * (nearest - r) * x / r

    return value


CONCENTRIC = around(2.0, 4.0)


@pytest.fixture(scope="module")
def cloud(concentric):
    return concentric[0]


def test_a_trained_field_passes(robust_field, exact_field):
    for trained in (robust_field, exact_field):
        check = check_field(trained)
        assert check.passed
        assert check.message == "2 of 2 pieces followed to the end"
        for piece, length in zip(check.pieces, (8 * np.pi, 4 * np.pi), strict=True):
            found = (piece.starts, piece.completed, piece.closed, piece.faults)
            assert found == (ALL, ALL, True, ())
            # Longest first, in the user's unit.
            assert piece.length == pytest.approx(length, rel=1e-3)


def test_direction_unit_and_slowness_do_not_matter(cloud):
    assert check_field(Stand(cloud, around(2.0, 4.0, sign=-1.0))).passed
    # The paper's form is slow on its path: |m| of 0.3 to 0.6 on the average.
    assert check_field(Stand(cloud, lambda x: 0.3 * CONCENTRIC(x))).passed
    for factor in (1e-3, 1e3):
        scaled = PointCloud(factor * cloud.points)
        check = check_field(Stand(scaled, lambda x, k=factor: CONCENTRIC(x / k)))
        assert check.passed
        assert check.pieces[0].length == pytest.approx(factor * 8 * np.pi, rel=1e-3)


def test_a_field_of_one_direction_fails_on_both_pieces(exact_field):
    """The tangent network is replaced by one that always says east."""
    network = exact_field.tangent_network
    constant = replace(
        network,
        weights=(*network.weights[:-1], 0 * network.weights[-1]),
        biases=(*network.biases[:-1], np.array([1.0, 0.0])),
    )
    check = check_field(replace(exact_field, tangent_network=constant))
    assert not check.passed
    for piece in check.pieces:
        # None of those that start on the piece.
        assert piece.completed <= STARTS_AROUND
        assert {"split"} < kinds(piece) <= {"split", "skip", "stall"}
    assert re.match(r"piece 1 \(length 25.1\): \d of 12 runs completed, ", check.message)
    assert "; piece 2 (length 12.6)" in check.message


def test_a_reversed_half_fails_and_is_named(cloud):
    """A source and a sink on the outer circle, the failure of a field without a hint."""

    def value(x):
        m, pull = CONCENTRIC(x), around(2.0, 4.0, sign=0)(x)
        reverse = (np.linalg.norm(x, axis=1) > 3) & (x[:, 0] < 0)
        return np.where(reverse[:, None], 2 * pull - m, m)

    check = check_field(Stand(cloud, value))
    assert not check.passed
    outer, inner = check.pieces
    assert outer.completed <= STARTS_AROUND
    assert (inner.completed, inner.faults) == (ALL, ())
    assert {"split"} < kinds(outer)
    (split,) = (fault for fault in outer.faults if fault.kind == "split")
    # The middle of the half that runs the wrong way: whichever half has fewer waypoints.
    np.testing.assert_allclose(np.abs(split.point), [4, 0], atol=0.3)
    assert check.message.startswith("piece 1 (length 25.1): ")
    assert f"split at ({split.point[0]:.3g}, " in check.message
    assert "piece 2" not in check.message


@pytest.mark.parametrize(("length", "splits"), [(0.2, False), (1.0, True)])
def test_only_a_stretch_of_some_length_is_a_split(cloud, length, splits):
    def value(x):
        m, pull = CONCENTRIC(x), around(2.0, 4.0, sign=0)(x)
        beside = 4 * np.abs(np.arctan2(x[:, 1], -x[:, 0])) < length / 2
        reverse = (np.linalg.norm(x, axis=1) > 3) & beside
        return np.where(reverse[:, None], 2 * pull - m, m)

    outer, inner = check_field(Stand(cloud, value)).pieces
    assert ("split" in kinds(outer)) == splits
    assert inner.faults == ()


def test_a_stall_fails_and_is_named(cloud):
    """One waypoint of the inner circle holds whoever comes."""
    trap = np.array([-2.0, 0.0])

    def value(x):
        near = np.exp(-0.5 * ((x - trap) ** 2).sum(axis=1) / 0.1**2)
        # Rather more than it takes to stop: back, for a tenth of a unit.
        return (1 - 2 * near)[:, None] * CONCENTRIC(x)

    check = check_field(Stand(cloud, value))
    assert not check.passed
    outer, inner = check.pieces
    assert (outer.completed, outer.faults) == (ALL, ())
    assert inner.completed < ALL
    stalls = [fault.point for fault in inner.faults if fault.kind == "stall"]
    assert stalls
    assert np.linalg.norm(np.array(stalls) - trap, axis=1).max() < 0.4
    assert check.message.startswith("piece 2 (length 12.6): ")
    assert "piece 1" not in check.message


def test_a_field_that_leaves_the_path_or_stands_still_fails(cloud):
    def spiral(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        return np.column_stack([-x[:, 1], x[:, 0]]) / r + 0.3 * x / r

    check = check_field(Stand(cloud, spiral))
    assert not check.passed
    assert kinds(check.pieces[0]) == {"leave"}
    dead = check_field(Stand(cloud, np.zeros_like))
    assert [piece.completed for piece in dead.pieces] == [0, 0]


def along_a_line(end=4.0):
    """Along the x axis at unit speed, to rest at (end, 0) over a tenth of a unit."""

    def value(x):
        speed = np.clip((end - x[:, 0]) / 0.1, -1, 1)
        return np.column_stack([speed, -2 * x[:, 1]])

    return value


def test_an_open_path_is_followed_from_its_start_to_rest_at_its_end():
    line = PointCloud(np.column_stack([np.linspace(-4, 4, 60), np.zeros(60)]))
    east = np.array([[4.0, 0.0]])
    check = check_field(Stand(line, along_a_line(), ends=east))
    assert check.passed, check.message
    # Only one run starts on the piece.
    assert check.pieces == (PieceCheck(pytest.approx(8), False, 1 + STARTS_AROUND, 9, ()),)
    # The other way, and without an end, it stalls.
    west = Stand(line, lambda x: along_a_line()(x * [-1, 1]) * [-1, 1], ends=east)
    assert "stall" in kinds(check_field(west).pieces[0])
    assert kinds(check_field(Stand(line, along_a_line())).pieces[0]) == {"stall"}
    for rest, kind in ((1.0, "stall"), (4.3, "stall"), (7.0, "leave")):
        (piece,) = check_field(Stand(line, along_a_line(end=rest), ends=east)).pieces
        assert piece.completed <= 1
        # However many runs end there.
        (point,) = (fault.point for fault in piece.faults if fault.kind == kind)
        np.testing.assert_allclose(point, [rest, 0], atol=0.1)
        # A stop is named as one, and not as the part of the path that it leaves unvisited.
        assert kinds(piece) <= {kind, "split"}


def test_the_place_of_a_fault_is_in_the_unit_of_the_waypoints():
    line = PointCloud(np.column_stack([np.linspace(1000, 9000, 60), np.zeros(60)]))
    value = along_a_line(end=1.0)
    east = np.array([[9000.0, 0.0]])
    stopped = Stand(line, lambda x: value((x - [5000.0, 0.0]) / 1000), ends=east)
    (piece,) = check_field(stopped).pieces
    (stall,) = (fault.point for fault in piece.faults if fault.kind == "stall")
    np.testing.assert_allclose(stall, [6000, 0], atol=100)


def test_only_the_pieces_that_were_learned_are_asked(cloud):
    circle, _ = make_shape("circle")
    strays = PointCloud(np.vstack([circle.points, [[6.0, 6.0], [-6.0, 6.0]]]))
    check = check_field(Stand(strays, around(3.0)))
    assert len(check.pieces) == 1
    assert check.passed
    # With only its outer circle, nothing is said of the inner one.
    path = find_paths(cloud).path
    check = check_field(Stand(cloud, around(4.0)), ReferencePath(path.pieces[:1]))
    assert check.passed, check.message
    assert len(check.pieces) == 1
    assert not check_field(Stand(cloud, around(4.0)), path).passed


def test_it_is_written_as_json():
    check = SelfCheck((PieceCheck(2.5, True, 12, 11, (Fault("stall", (1.0, -2.0)),)),))
    message = "piece 1 (length 2.5): 11 of 12 runs completed, stall at (1, -2)"
    piece = {"length": 2.5, "closed": True, "starts": 12, "completed": 11}
    piece["faults"] = [{"kind": "stall", "point": [1.0, -2.0]}]
    assert json.loads(json.dumps(check.to_json())) == {
        "passed": False,
        "message": message,
        "pieces": [piece],
    }
