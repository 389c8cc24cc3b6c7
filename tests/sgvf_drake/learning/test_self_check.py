from dataclasses import dataclass, replace
import json
import re

import numpy as np
import pytest

from sgvf_drake.learning import SelfCheck, check_field
from sgvf_drake.learning.self_check import STARTS, STARTS_AROUND, Fault, PieceCheck
from sgvf_drake.learning.support import find_support
from sgvf_drake.paths import PointCloud, make_shape

ALL = STARTS + STARTS_AROUND


def kinds(piece):
    return {fault.kind for fault in piece.faults}


@dataclass
class Stand:
    """What the self-check asks of a field: a cloud, a noise level, and a value."""

    cloud: PointCloud
    value: object
    sigma: float = 0.1
    ends: object = None

    def __post_init__(self):
        if self.ends is None:
            self.ends = np.empty((0, 2))

    def __call__(self, x):
        return self.value(x)


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


@pytest.mark.parametrize("result", ["robust_result", "exact_result"])
def test_a_trained_field_passes(result, request):
    check = check_field(request.getfixturevalue(result).field)
    assert check.passed
    assert check.message == "2 of 2 pieces followed to the end"
    assert [piece.completed for piece in check.pieces] == [ALL, ALL]
    assert [(piece.starts, piece.closed, piece.faults) for piece in check.pieces] == [
        (ALL, True, ())
    ] * 2
    # Longest first, in the user's unit.
    assert [piece.length for piece in check.pieces] == pytest.approx(
        [8 * np.pi, 4 * np.pi], rel=1e-3
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_either_direction_of_a_closed_piece_passes(cloud, sign):
    assert check_field(Stand(cloud, around(2.0, 4.0, sign=sign))).passed


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_unit_does_not_matter(cloud, factor):
    scaled = PointCloud(factor * cloud.points)
    check = check_field(Stand(scaled, lambda x: CONCENTRIC(x / factor)))
    assert check.passed
    assert check.pieces[0].length == pytest.approx(factor * 8 * np.pi, rel=1e-3)


def test_a_slow_field_is_given_time(cloud):
    """The paper's form is slow on its path: |m| of 0.3 to 0.6 on the average."""
    assert check_field(Stand(cloud, lambda x: 0.3 * CONCENTRIC(x))).passed


def test_a_field_of_one_direction_fails_on_both_pieces(exact_result):
    """The tangent network is replaced by one that always says east."""
    field = exact_result.field
    network = field.tangent_network
    constant = replace(
        network,
        weights=(*network.weights[:-1], 0 * network.weights[-1]),
        biases=(*network.biases[:-1], np.array([1.0, 0.0])),
    )
    check = check_field(replace(field, tangent_network=constant))
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
        m, pull = around(2.0, 4.0)(x), around(2.0, 4.0, sign=0)(x)
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
    assert "stall" in kinds(inner)
    for fault in inner.faults:
        if fault.kind == "stall":
            assert np.linalg.norm(np.subtract(fault.point, trap)) < 0.4
    assert check.message.startswith("piece 2 (length 12.6): ")
    assert "piece 1" not in check.message


def test_a_field_that_leaves_the_path_fails(cloud):
    def outward(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        return np.column_stack([-x[:, 1], x[:, 0]]) / r + 0.3 * x / r

    check = check_field(Stand(cloud, outward))
    assert not check.passed
    assert kinds(check.pieces[0]) == {"leave"}


def test_a_dead_field_fails_quickly(cloud):
    check = check_field(Stand(cloud, np.zeros_like))
    assert [piece.completed for piece in check.pieces] == [0, 0]


def along_a_line(end=4.0):
    """Along the x axis at unit speed, to rest at (end, 0) over a tenth of a unit."""

    def value(x):
        speed = np.clip((end - x[:, 0]) / 0.1, -1, 1)
        return np.column_stack([speed, -2 * x[:, 1]])

    return value


@pytest.fixture
def line():
    x = np.linspace(-4, 4, 60)
    return PointCloud(np.column_stack([x, np.zeros(60)]))


EAST = np.array([[4.0, 0.0]])


def test_an_open_path_is_followed_from_its_start_to_rest_at_its_end(line):
    check = check_field(Stand(line, along_a_line(), ends=EAST))
    assert check.passed, check.message
    # Only one run starts on the piece.
    assert check.pieces == (PieceCheck(pytest.approx(8), False, 1 + STARTS_AROUND, 9, ()),)


def test_an_open_path_fails_the_other_way(line):
    def west(x):
        return along_a_line()(x * [-1, 1]) * [-1, 1]

    check = check_field(Stand(line, west, ends=EAST))
    assert not check.passed
    assert "stall" in kinds(check.pieces[0])


@pytest.mark.parametrize(("rest", "kind"), [(1.0, "stall"), (4.3, "stall"), (7.0, "leave")])
def test_rest_short_of_the_end_or_beyond_it_is_told(line, rest, kind):
    check = check_field(Stand(line, along_a_line(end=rest), ends=EAST))
    (piece,) = check.pieces
    assert piece.completed <= 1
    # However many runs end there.
    (point,) = (fault.point for fault in piece.faults if fault.kind == kind)
    np.testing.assert_allclose(point, [rest, 0], atol=0.1)
    # A stop is named as one, and not as the part of the path that it leaves unvisited.
    assert kinds(piece) <= {kind, "split"}


def test_an_open_path_that_ends_nowhere_fails(line):
    check = check_field(Stand(line, along_a_line()))
    assert kinds(check.pieces[0]) == {"stall"}


def test_stray_waypoints_are_no_piece():
    circle, _ = make_shape("circle")
    strays = PointCloud(np.vstack([circle.points, [[6.0, 6.0], [-6.0, 6.0]]]))
    check = check_field(Stand(strays, around(3.0)))
    assert len(check.pieces) == 1
    assert check.passed


def test_nothing_to_follow_is_not_passed():
    check = SelfCheck(())
    assert not check.passed
    assert check.message == "no piece has 3 waypoints, so there is nothing to follow"


def test_the_support_that_was_learned_from_is_asked(cloud):
    """With only its outer circle, nothing is said of the inner one."""
    support = find_support(cloud.normalize(cloud.points))
    outer = replace(support, pieces=support.pieces[:1])
    check = check_field(Stand(cloud, around(4.0)), outer)
    assert check.passed, check.message
    assert len(check.pieces) == 1
    assert not check_field(Stand(cloud, around(4.0)), support).passed


def test_it_is_written_as_json():
    check = SelfCheck((PieceCheck(2.5, True, 12, 11, (Fault("stall", (1.0, -2.0)),)),))
    message = "piece 1 (length 2.5): 11 of 12 runs completed, stall at (1, -2)"
    assert json.loads(json.dumps(check.to_json())) == {
        "passed": False,
        "message": message,
        "pieces": [
            {
                "length": 2.5,
                "closed": True,
                "starts": 12,
                "completed": 11,
                "faults": [{"kind": "stall", "point": [1.0, -2.0]}],
            }
        ],
    }
