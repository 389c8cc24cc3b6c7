"""Waypoints from files: every dialect, and one error that names file, line and value."""

import numpy as np
import pytest

from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths import read_points
from sgvf_drake.paths.reading import read_waypoints

POINTS = np.array([[1.0, 2.0], [-3.5, 4e-3], [5.0, 6.25]])
DIALECTS = (
    "1,2\n-3.5,4e-3\n5,6.25\n",
    "1, 2\n-3.5, 4e-3\n5, 6.25",
    "1;2\r\n-3.5;4e-3\r\n5;6.25\r\n",
    "1\t2\n-3.5\t4e-3\n5\t6.25\n",
    "  1   2\n-3.5 4e-3 \n\n5 6.25\n",
    "x,y\n1,2\n-3.5,4e-3\n5,6.25\n",
    "X [m];Y [m]\n1;2\n-3.5;4e-3\n5;6.25\n",
    "# recorded on a Monday\n1,2\n# a pause\n-3.5,4e-3  # here\n5,6.25\n",
    "time,y_m,x_m,w\n0,2,1,n/a\n1,4e-3,-3.5,n/a\n2,6.25,5,\n",
    "# x_m,y_m,w_right,w_left\n1,2,0,0\n-3.5,4e-3,0,0\n5,6.25,0,0\n",
    '"x","y","name"\n"1","2","lap #1, north"\n-3.5,4e-3,""\n5,6.25,""\n',
    '"x" "y"\n1 2\n-3.5 4e-3\n5 6.25\n',
    ",x,y\n0,1,2\n1,-3.5,4e-3\n2,5,6.25\n",
    b"\xef\xbb\xbfx,y\n1,2\n-3.5,4e-3\n5,6.25\n",
    "1,2\r-3.5,4e-3\r5,6.25\r",
    # A commented-out line of data is not a header.
    "# 9, 9\n1,2\n-3.5,4e-3\n5,6.25\n",
)
VELOCITIES = (
    ("x,y,vx,vy", None, [0, 1], [2, 3]),
    ("vy,y,vx,x", None, [3, 1], [2, 0]),
    ("X [m],Y [m],Vx [m/s],V_Y [m/s]", None, [0, 1], [2, 3]),
    ("x,y,z,vx,vy,vz", None, [0, 1, 2], [3, 4, 5]),
    ("x,y,vx,vy,vz", None, [0, 1], [2, 3]),
    ("x,y,vx_std,vx,vy", None, [0, 1], [3, 4]),
    ("x,y,vx,vy", "y,x", [1, 0], [3, 2]),
    ("east,north,vx,vy", "east,north", [0, 1], [2, 3]),
    ("x,y,vx,vy", "0,1", [0, 1], [2, 3]),
    # None, where they do not go with the coordinates.
    ("x,y,speed", None, [0, 1], None),
    ("x,y,vx", None, [0, 1], None),
    ("x,y,z,vx,vy", None, [0, 1, 2], None),
    ("x,y,vx_std,vx_mps,vy", None, [0, 1], None),
    ("east,north,vx,vy,vz", "east,north", [0, 1], None),
    ("vx,vy", None, [0, 1], None),
    ("x,y,vxy,vyaw", None, [0, 1], None),
)
BAD_TEXTS = (
    ("x,y\n1,2\n3,abc\n", None, r"waypoints.csv, line 3: 'abc' is not a number"),
    ("1,2\n\n# pause\n3,\n", None, r"line 4: '' is not a number"),
    ("1,2\n3,4_0\n", None, r"line 2: '4_0' is not a number"),
    ("1,2\n3,nan\n", None, r"line 2: 'nan' is not finite"),
    ("1,2\n-inf,4\n", None, r"line 2: '-inf' is not finite"),
    ("1,2\n3,1e999\n", None, r"line 2: '1e999' is not finite"),
    ("1,2\n3,4,5\n", None, r"line 2: 3 fields, not 2"),
    ("x,y\n1\n", None, r"line 2: 1 fields, not 2"),
    ("1;2\n1,5;2,5\n", None, r"line 2: '1,5' is not a number"),
    ("", None, "it is empty"),
    ("\n# nothing\n\n", None, "it is empty"),
    ("x,y\n", None, "only a header"),
    ("1\n2\n", None, "two columns or more, not 1"),
    ("1,2,3,4\n5,6,7,8\n", None, "4 columns .columns 0 to 3, without names"),
    ("a,b,c,d\n5,6,7,8\n", None, "cannot tell .* 'a', 'b', 'c', 'd'"),
    ("x,y,x_ref,y_ref\n5,6,7,8\n", None, "cannot tell which columns"),
    ("x,y\n1,2\n", ["x", "lat"], "no column 'lat'; it has columns 'x', 'y'"),
    ("1,2\n3,4\n", ["x", "y"], "no column 'x'; it has columns 0 to 1"),
    ("x,y\n1,2\n", [0, 2], "no column 2; it has columns 0 to 1"),
    ("x,y\n1,2\n", [0, -1], "no column -1"),
    ("x,y\n1,2\n", ["x", 0], "column 0 is chosen twice"),
    ("x,y\n1,2\n", ["x"], "two columns or more, not 1"),
    ("x,x\n1,2\n", ["x", 1], "two columns are named 'x'"),
    ('x,y\n1,2\n"3,4\n5,6\n', None, "line 3: "),
    (b"x,y\n1,2\n3,\xff\n", None, "line 3: this is not UTF-8"),
    (b"\x89PNG\x00\x00\x01", None, "is not a text file"),
)
BAD_ARRAYS = (
    (np.zeros(4), r"holds an array \(4,\)"),
    (np.zeros((0, 2)), r"holds an array \(0, 2\)"),
    (np.zeros((3, 2), dtype=complex), "complex128, not real numbers"),
    (np.array([["a", "b"]]), "not real numbers"),
    (np.array([[1.0, 2], [3, np.nan]]), "waypoint 1: .* is not finite"),
    (np.zeros((3, 4)), "cannot tell which columns"),
    # Pickles are never loaded.
    (np.array([[1, None]], dtype=object), r"not a readable \.npy file"),
)


@pytest.fixture
def write(tmp_path):
    """Writes a file of waypoints, and returns its path."""

    def write_file(content, name="waypoints.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_file


def test_dialects_of_text(write):
    for content in DIALECTS:
        np.testing.assert_array_equal(read_points(write(content)), POINTS, err_msg=str(content))


def test_columns_by_name_and_number(write):
    path = write("x,y,z,w\n1,2,3,4\n5,6,7,8\n")
    for columns, expected in (
        (None, [[1, 2, 3], [5, 6, 7]]),
        (["y", "w"], [[2, 4], [6, 8]]),
        (["w", 0], [[4, 1], [8, 5]]),
        ("0,1", [[1, 2], [5, 6]]),
        ("y, x", [[2, 1], [6, 5]]),
        (["2", "3", "0"], [[3, 4, 1], [7, 8, 5]]),
    ):
        np.testing.assert_array_equal(read_points(path, columns), expected)
    # Three columns without names are all taken.
    np.testing.assert_array_equal(read_points(write("1 2 3\n4 5 6\n")), [[1, 2, 3], [4, 5, 6]])
    # Beside a semicolon a comma is a part of a field.
    path = write("1;2;start, slow\n3;4;\n")
    np.testing.assert_array_equal(read_points(path, "0,1"), [[1, 2], [3, 4]])


def test_velocities_are_read_beside_their_coordinates(write):
    for header, columns, points, velocities in VELOCITIES:
        rng = np.random.default_rng(0)
        values = rng.standard_normal((4, header.count(",") + 1)).round(3)
        path = write("\n".join([header, *(",".join(map(str, row)) for row in values)]))
        found, moving = read_waypoints(path, columns)
        np.testing.assert_array_equal(found, values[:, points], err_msg=header)
        np.testing.assert_array_equal(read_points(path, columns), found)
        if velocities is None:
            assert moving is None, header
        else:
            np.testing.assert_array_equal(moving, values[:, velocities], err_msg=header)
    # Bad ones are refused, but not by who wants none.
    path = write("x,y,vx,vy\n0,1,2,3\n4,5,,7\n")
    with pytest.raises(PointCloudError, match=r"waypoints.csv, line 3: '' is not a number"):
        read_waypoints(path)
    np.testing.assert_array_equal(read_points(path), [[0, 1], [4, 5]])


def test_npy(tmp_path):
    path = tmp_path / "points.npy"
    for dtype in (np.float64, np.float32, np.int16):
        points = np.arange(12).reshape(4, 3).astype(dtype)
        np.save(path, points)
        read, velocities = read_waypoints(path)
        assert read.dtype == np.float64
        assert velocities is None
        np.testing.assert_array_equal(read, points)
        np.testing.assert_array_equal(read_points(path, [2, 0]), points[:, [2, 0]])


def test_100_000_lines_are_read_exactly(tmp_path):
    points = np.random.default_rng(0).standard_normal((100_000, 2))
    np.savetxt(tmp_path / "many.csv", points, delimiter=",", header="x,y")
    np.testing.assert_array_equal(read_points(tmp_path / "many.csv"), points)


def test_bad_files_are_refused(write, tmp_path):
    for content, columns, match in BAD_TEXTS:
        with pytest.raises(PointCloudError, match=match) as error:
            read_points(write(content), columns)
        assert str(error.value).startswith(str(tmp_path / "waypoints.csv"))
    for array, match in BAD_ARRAYS:
        np.save(tmp_path / "points.npy", array, allow_pickle=array.dtype == object)
        with pytest.raises(PointCloudError, match=match):
            read_points(tmp_path / "points.npy")
    np.save(tmp_path / "points.npy", np.zeros((100, 2)))
    whole = (tmp_path / "points.npy").read_bytes()
    for content in (whole[:200], b"", b"x,y\n1,2\n"):
        with pytest.raises(PointCloudError, match=r"not a readable \.npy file"):
            read_points(write(content, "points.npy"))
    with pytest.raises(PointCloudError, match=r"missing\.csv: there is no such file"):
        read_points(tmp_path / "missing.csv")
    with pytest.raises(PointCloudError, match="is a folder"):
        read_points(tmp_path)
