"""A point cloud: what it knows of itself, and what is no cloud."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import PointCloudError

CORNERS = [[0, 0], [8, 0], [8, 2], [0, 2]]


def test_what_a_cloud_knows():
    cloud = PointCloud(CORNERS)
    assert cloud.points.dtype == np.float64
    assert (cloud.num_points, cloud.dim) == (4, 2)
    np.testing.assert_array_equal(cloud.center, [4, 1])
    assert cloud.half_extent == 4
    assert cloud.unit_length == 1
    np.testing.assert_array_equal(cloud.box, [[-1, -4], [9, 6]])
    assert repr(cloud) == "PointCloud(4 points in 2-D)"
    assert repr(PointCloud(CORNERS, shape="box")) == "PointCloud(4 points in 2-D, shape='box')"


def test_points_and_velocities_are_read_only_copies():
    points, velocities = np.array(CORNERS, dtype=float), np.arange(8.0).reshape(4, 2)
    cloud = PointCloud(points, velocities=velocities)
    points[0, 0] = velocities[0, 0] = 99
    np.testing.assert_array_equal(cloud.points, CORNERS)
    np.testing.assert_array_equal(cloud.velocities, np.arange(8.0).reshape(4, 2))
    for array in (cloud.points, cloud.velocities):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    assert PointCloud(CORNERS).velocities is None
    # The cloud is its points: a field stays the same, however its direction was found.
    assert cloud.digest == PointCloud(CORNERS).digest
    assert PointCloud(CORNERS, breaks=np.array([1, 3])).breaks == (1, 3)
    # Waypoints may coincide, but not all of them.
    assert PointCloud([[0, 0], [0, 0], [1, 1]]).num_points == 3


def test_the_digest_is_of_the_values_alone():
    array = np.array(CORNERS, dtype=float)
    digest = PointCloud(array).digest
    assert len(digest) == 64
    assert PointCloud(np.asfortranarray(array), shape="box").digest == digest
    assert PointCloud(CORNERS).digest == digest
    assert PointCloud(array[::-1]).digest != digest
    assert PointCloud(array.reshape(2, 4)).digest != digest


@settings(max_examples=30, derandomize=True)
@given(
    scale=st.floats(1e-6, 1e6),
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
    n=st.integers(0, 5),
)
def test_normalising_spans_four_units_and_comes_back(scale, x, y, n):
    cloud = PointCloud(scale * (np.array(CORNERS) + np.array([x, y])))
    normalized = cloud.normalize(cloud.points)
    np.testing.assert_allclose(normalized[:, 0], [-4, 4, 4, -4], atol=1e-9)
    np.testing.assert_allclose(normalized[:, 1], [-1, -1, 1, 1], atol=1e-9)
    more = np.full((n, 3, 2), scale)
    back = cloud.denormalize(cloud.normalize(more))
    np.testing.assert_allclose(back, more, rtol=1e-9, atol=1e-9 * cloud.half_extent)


def test_reading(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,vx,vy\n0,1,2,0\n3,4,5,-1\n")
    cloud = PointCloud.read(tmp_path / "points.csv")
    np.testing.assert_array_equal(cloud.points, [[0, 1], [3, 4]])
    np.testing.assert_array_equal(cloud.velocities, [[2, 0], [5, -1]])
    chosen = PointCloud.read(tmp_path / "points.csv", columns=["vx", "x"])
    np.testing.assert_array_equal(chosen.points, [[2, 0], [5, 3]])
    (tmp_path / "still.csv").write_text("x,y\n0,1\n3,4\n")
    assert PointCloud.read(tmp_path / "still.csv").velocities is None
    (tmp_path / "one.csv").write_text("x,y\n0,1\n")
    with pytest.raises(PointCloudError, match=r"one\.csv: a path needs at least 2"):
        PointCloud.read(tmp_path / "one.csv")


@pytest.mark.filterwarnings("ignore:overflow")
def test_what_cannot_be_followed_is_refused():
    bad = np.eye(20)[:, :2] / np.where(np.arange(20) == 17, np.nan, 1)[:, None]
    for points, match in (
        ([1.0, 2.0], r"not \(2,\)"),
        (np.zeros((2, 2, 2)), r"not \(2, 2, 2\)"),
        ([[1.0], [2.0]], "at least 2 coordinates, not 1"),
        ([[1.0, 2.0]], "at least 2 waypoints, not 1"),
        (np.zeros((0, 2)), "at least 2 waypoints, not 0"),
        (np.eye(2, 400), "2 points in 400-D: transposed"),
        (np.eye(3, 50), "3 points in 50-D: transposed"),
        ([[1, 2], [3]], "do not all have the same length"),
        ([["a", "b"], ["c", "d"]], "real numbers, not <U1"),
        ([[1j, 2], [3, 4]], "real numbers, not complex128"),
        ([[1, None], [3, 4]], "real numbers, not object"),
        (np.zeros((3, 2), dtype=bool), "real numbers, not bool"),
        (bad, "waypoint 17"),
        ([[1, 2], [np.inf, 0]], r"waypoint 1 is not finite: \[inf, 0.0\]"),
        ([[1, 2]] * 5, r"all 5 waypoints coincide at \[1.0, 2.0\]"),
        ([[-1.5e308, 0], [1.5e308, 0]], "choose another unit"),
        ([[0, 0], [1e-200, 0]], "choose another unit"),
        ([[0, 0], [1e120, 0]], "choose another unit"),
        ([[1e9, 0], [1e9 + 1e-1, 0]], "subtract an offset"),
    ):
        with pytest.raises(PointCloudError, match=match):
            PointCloud(points)
    for breaks in ([0], [4], [2, 2], [3, 1], [-1]):
        with pytest.raises(PointCloudError, match="breaks must rise between 0 and 4, not be"):
            PointCloud(CORNERS, breaks=breaks)
    for velocities, match in (
        (np.ones((3, 2)), r"velocities are an array \(3, 2\), but the waypoints are \(4, 2\)"),
        (np.ones((4, 3)), r"\(4, 3\), but"),
        (np.ones(4), r"\(4,\), but"),
        ([[1, 0], [1, np.nan], [0, 0], [0, 0]], r"velocity 1 is not finite: \[1.0, nan\]"),
        ([[1, 0], [0, 0], [0, 0], [np.inf, 0]], "velocity 3 is not finite"),
        ([["a", 0]] * 4, "velocities must be real numbers"),
        ([[1, 0], [1]], "velocities must be real numbers"),
    ):
        with pytest.raises(PointCloudError, match=match):
            PointCloud(CORNERS, velocities=velocities)
