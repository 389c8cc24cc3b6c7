"""Tables in text: every dialect, which columns are taken, and what is said of them."""

import gzip
import shlex

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.clouds.reading import read_recording
from sgvf_drake.exceptions import PointCloudError

POINTS = np.array([[1.0, 2.0], [-3.5, 4e-3], [5.0, 6.25]])
DIALECTS = (
    "1,2\n-3.5,4e-3\n5,6.25\n",
    "1, 2\n-3.5, 4e-3\n5, 6.25",
    "1;2\r\n-3.5;4e-3\r\n5;6.25\r\n",
    "1\t2\n-3.5\t4e-3\n5\t6.25\n",
    "  1   2\n-3.5 4e-3 \n\n5 6.25\n",
    "1 \t2\n-3.5\t 4e-3\n5\t6.25\n",
    "1,\t2\n-3.5,\t4e-3\n5,\t6.25\n",
    "x,y\n1,2\n-3.5,4e-3\n5,6.25\n",
    "X [m];Y [m]\n1;2\n-3.5;4e-3\n5;6.25\n",
    "X [m] Y [m]\n1 2\n-3.5 4e-3\n5 6.25\n",
    "# recorded on a Monday\n1,2\n# a pause\n-3.5,4e-3  # here\n5,6.25\n",
    "time,y_m,x_m,w\n0,2,1,n/a\n1,4e-3,-3.5,n/a\n2,6.25,5,\n",
    "# x_m,y_m,w_right,w_left\n1,2,0,0\n-3.5,4e-3,0,0\n5,6.25,0,0\n",
    "# s x y\n0 1 2\n1 -3.5 4e-3\n2 5 6.25\n",
    "# s_m; not used\n# x_m; y_m\n1; 2\n-3.5; 4e-3\n5; 6.25\n",
    "# s, x, y\n0 1 2\n1 -3.5 4e-3\n2 5 6.25\n",
    "%time,field.x,x,y\n0,9,1,2\n1,9,-3.5,4e-3\n2,9,5,6.25\n",
    "// made by hand\n1 2\n// a pause\n-3.5 4e-3\n5 6.25\n",
    '"x","y","name"\n"1","2","lap #1, north"\n-3.5,4e-3,""\n5,6.25,""\n',
    '"x" "y"\n1 2\n-3.5 4e-3\n5 6.25\n',
    ",x,y\n0,1,2\n1,-3.5,4e-3\n2,5,6.25\n",
    "0,1\n1.0,2.0\n-3.5,0.004\n5.0,6.25\n",
    b"\xef\xbb\xbfx,y\n1,2\n-3.5,4e-3\n5,6.25\n",
    "x,y\n1,2\n-3.5,4e-3\n5,6.25\n".encode("utf-16"),
    "x,y\n1,2\n-3.5,4e-3\n5,6.25\n".encode("utf-32"),
    "x,y,Höhe\n1,2,3\n-3.5,4e-3,3\n5,6.25,3\n".encode("latin-1"),
    gzip.compress(b"x,y\n1,2\n-3.5,4e-3\n5,6.25\n"),
    "1,2\r-3.5,4e-3\r5,6.25\r",
    "1,2\n-3.5,4e-3\n5,6.25\n\x1a",
    "sep=;\nx;y\n1;2\n-3.5;4e-3\n5;6.25\n",
    # A commented-out line of data is not a header.
    "# 9, 9\n1,2\n-3.5,4e-3\n5,6.25\n",
    # Trailing delimiters, in the data, in the header and in both.
    "x,y\n1,2,\n-3.5,4e-3,\n5,6.25,\n",
    "x,y,\n1,2\n-3.5,4e-3\n5,6.25\n",
    "x,y,\n1,2,\n-3.5,4e-3,\n5,6.25,\n",
    "1,2,\n-3.5,4e-3,\n5,6.25,\n",
    "x;y;;\n1;2;;\n-3.5;4e-3;;\n5;6.25;;\n",
    # A line of units.
    "x,y\n[m],[m]\n1,2\n-3.5,4e-3\n5,6.25\n",
    "t;x;y\ns;m;m\n0;1;2\n1;-3.5;4e-3\n2;5;6.25\n",
    # Decimal commas.
    "x;y\n1;2\n-3,5;4e-3\n5,0;6,25\n",
    "x\ty\n1,0\t2,0\n-3,5\t4e-3\n5\t6,25\n",
    'x,y\n"1,0","2"\n"-3,5","0,004"\n"5","6,25"\n',
)
VELOCITIES = (
    ("x,y,vx,vy", None, [0, 1], [2, 3]),
    ("vy,y,vx,x", None, [3, 1], [2, 0]),
    ("X [m],Y [m],Vx [m/s],V_Y [m/s]", None, [0, 1], [2, 3]),
    ("x,y,z,vx,vy,vz", None, [0, 1, 2], [3, 4, 5]),
    ("x,y,vx,vy,vz", None, [0, 1], [2, 3]),
    ("x,y,vx_std,vx,vy", None, [0, 1], [3, 4]),
    ("x,y,vx_std,vx_mps,vy", None, [0, 1], [3, 4]),
    ("x,y,vx_raw,vy_raw,vx,vy", None, [0, 1], [4, 5]),
    ("x,y,vx,vy", "y,x", [1, 0], [3, 2]),
    ("east,north,vx,vy", "east,north", [0, 1], [2, 3]),
    ("a,b,vx,vy", "a,b", [0, 1], [2, 3]),
    ("x,y,vx,vy", "0,1", [0, 1], [2, 3]),
    ("t,px,py,x_vel,y_vel", None, [1, 2], [3, 4]),
    ("posX,posY,velX,velY", None, [0, 1], [2, 3]),
    ("y,x,y_dot,xdot", None, [1, 0], [3, 2]),
    ("n,e,vn,ve", None, [1, 0], [3, 2]),
    # None, where they do not go with the coordinates.
    ("x,y,speed", None, [0, 1], None),
    ("a,b,vx,vy", "vx,vy", [2, 3], None),
    ("x,y,vx", None, [0, 1], None),
    ("x,y,z,vx,vy", None, [0, 1, 2], None),
    ("x,y,vx_l,vy_l,vx_r,vy_r", None, [0, 1], None),
    ("east,north,vx,vy,vz", "east,north", [0, 1], None),
    ("x,y,vxy,vyaw", None, [0, 1], None),
    # A twist of ROS is along the axes of the robot.
    ("pose.position.x,pose.position.y,twist.linear.x,twist.linear.y", None, [0, 1], None),
)
KNOWN = (
    ("%time,field.pose.pose.position.x,field.pose.pose.position.y", [1, 2]),
    (".header.stamp,.position.x,.position.y,.orientation.x,.orientation.y", [1, 2]),
    (
        "/odom/pose/pose/position/x,/odom/pose/pose/position/y,/odom/pose/pose/position/z",
        [0, 1, 2],
    ),
    ("timestamp,position[0],position[1],q[0],q[1],velocity[0],velocity[1]", [1, 2]),
    ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x []", [1, 2, 3]),
    ("transform.translation.y,transform.translation.x,transform.rotation.x", [1, 0]),
    ("northing,easting", [1, 0]),
    ("id,utm_easting,utm_northing,height", [1, 2]),
    ("s_m,x_m,y_m,psi_rad,kappa_radpm,vx_mps,ax_mps2", [1, 2]),
    ("x_ref_m,y_ref_m,width_right_m,x_normvec_m,y_normvec_m", [0, 1]),
    ("x,y,x_std,y_std,ax,ay,acc_x,acc_y,force_x,force_y", [0, 1]),
    ("Up,North,East", [2, 1, 0]),
    ("%time,field.x,field.y,field.theta,field.magnetic_field.x", [1, 2]),
    ("Frame,Position X (mm),Position Y (mm),Rotation X,Rotation Y", [1, 2]),
    ("TX,TY,TZ,RX,RY,RZ", [0, 1, 2]),
)
UNDECIDED = (
    ("a,b", "coordinates .none has a name known as one.*'a', 'b'; .* --columns a,b$"),
    ("vx,vy", "--columns vx,vy$"),
    ("t,speed,heading", "columns 't', 'speed', 'heading'; choose, as in --columns"),
    ("x,y,x_ref,y_ref", ".2 sets of them.*--columns x,y$"),
    ("lat,lon,x,y", "2 sets of them"),
    ("home_lat,home_lon,lat,lon", "2 sets of them"),
    ("lat_rad,lon_rad", "none has a name known"),
    ("lat [rad],lon [rad]", "none has a name known"),
    ("x,x,y", "columns with the same meaning.*--columns 0,1$"),
    ("x,speed", "none has a name"),
    (",0,1", "--columns 0,1$"),
    (",".join(f"c{n}" for n in range(50)), "'c11' and 38 more; choose, as in --columns c0,c1$"),
    (3, "which of its 3 columns without names .*--columns 0,1 .or --columns 0,1,2 in space.$"),
    (4, "which of its 4 columns without names"),
    (8, "which of its 8 columns without names"),
    (12, "which of its 12 columns without names"),
)


def table(header, rows=5, seed=0):
    """A table with a header, or without names but with as many columns."""
    width = header if isinstance(header, int) else header.count(",") + 1
    values = np.random.default_rng(seed).standard_normal((rows, width)).round(3)
    lines = [",".join(map(str, row)) for row in values]
    return values, "\n".join(lines if isinstance(header, int) else [header, *lines])


def test_dialects_of_text(write):
    for content in DIALECTS:
        found = read_recording(write(content))
        np.testing.assert_array_equal(found.points, POINTS, err_msg=str(content))


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
        np.testing.assert_array_equal(read_recording(path, columns).points, expected)
    path = write("1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(read_recording(path, "0,1,2").points, [[1, 2, 3], [4, 5, 6]])
    # Beside a semicolon a comma is a part of a field.
    path = write("1;2;start, slow\n3;4;\n")
    np.testing.assert_array_equal(read_recording(path, "0,1").points, [[1, 2], [3, 4]])


def test_known_names_of_positions_and_velocities(write):
    cases = [(header, None, points, None) for header, points in KNOWN]
    for header, columns, points, velocities in [*VELOCITIES, *cases]:
        values, text = table(header)
        found = read_recording(write(text), columns)
        np.testing.assert_array_equal(found.points, values[:, points], err_msg=header)
        if velocities is None:
            assert found.velocities is None or header in dict(KNOWN), header
        else:
            np.testing.assert_array_equal(
                found.velocities, values[:, velocities], err_msg=header
            )
    # Where a robot's velocity is not known it is zero.
    found = read_recording(write("x,y,vx,vy\n0,1,2,3\n4,5,nan,\n"))
    np.testing.assert_array_equal(found.velocities, [[2, 3], [0, 0]])


def test_a_choice_is_left_to_the_user_in_one_line(write):
    for header, match in UNDECIDED:
        path = write(table(header)[1])
        with pytest.raises(PointCloudError, match=match) as error:
            read_recording(path)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < len(str(path)) + 330
        # The example that it gives works.
        suggested = shlex.split(str(error.value).split("--columns ")[-1])[0].strip(")")
        if "with the same meaning" not in match:
            assert read_recording(path, suggested).points.shape[0] == 5
    # A height in the middle is seen.
    path = write("\n".join(f"{t} 0.0 {t * t}" for t in range(9)))
    with pytest.raises(PointCloudError, match=r"column 1 is constant; .*--columns 0,2$"):
        read_recording(path)


def test_north_east_down_becomes_east_north_up(write):
    values, text = table("n,e,d,vn,ve,vd")
    found = read_recording(write(text))
    turned = values[:, [1, 0, 2]] * [1, 1, -1]
    np.testing.assert_array_equal(found.points, turned)
    np.testing.assert_array_equal(found.velocities, values[:, [4, 3, 5]] * [1, 1, -1])
    assert found.messages[1] == "waypoints.csv: north, east, down became east, north, up"
    for header in ("North,East,Down", "ned_x,ned_y,ned_z", "down,pos_ned_y,pos_ned_x"):
        values, text = table(header)
        found = read_recording(write(text), None if "pos" not in header else [2, 1, 0])
        order = [1, 0, 2] if "pos" not in header else [1, 2, 0]
        np.testing.assert_array_equal(found.points, values[:, order] * [1, 1, -1])


def test_gaps_and_blank_lines_separate_pieces(write):
    four = [[0, 1], [2, 3], [4, 5], [6, 7]]
    for text, points, breaks in (
        ("x,y\n0,1\n2,3\nnan,nan\n4,5\n6,7\n", four, (2,)),
        (
            "x,y,s\n0,1,8\n2,3,8\n,,9\n,,9\n4,5,8\n6,7,8\n",
            [[0, 1], [2, 3], [4, 5], [6, 7]],
            (2,),
        ),
        ("0 1\n2 3\n\n\n4 5\n6 7\n\n", four, (2,)),
        ("\n0 1\n2 3\n# no gap\n4 5\n6 7\n", four, ()),
        ("nan nan\n0 1\n2 3\n\nNaN NaN\n\n4 5\n6 7\n8 9\nnan nan\n", None, (2,)),
        ("0,1\n2,3\n,\n4,5\n6,7\n;;\n".replace(";;", ",,"), None, (2,)),
        # Blank lines between all of the lines are layout.
        ("0 1\n\n2 3\n\n4 5\n\n6 7\n", four, ()),
    ):
        found = read_recording(write(text))
        assert found.breaks == breaks, text
        if points is not None:
            np.testing.assert_array_equal(found.points, points)
    message = PointCloud.read(write("x,y\n0,1\n2,3\nnan,nan\n4,5\n6,7\n")).messages
    assert message == ("waypoints.csv: CSV, 4 points in 2 pieces, x, y, 6 x 6",)


def test_what_is_said_of_a_file(write):
    for text, columns, expected in (
        ("x_m,y_m\n0,0\n3,4\n", None, ["CSV, 2 points, x_m, y_m, 3 m x 4 m"]),
        (
            "x;y\nmm;mm\n0;0\n4,0;4\n",
            None,
            ["text with semicolons, 2 points, x, y, 4 mm x 4 mm"],
        ),
        ("0 0\n12345 4\n", None, ["text, 2 points, columns 0, 1, 12345 x 4"]),
        (
            "x,y,vx,vy\n0,0,1,1\n3,4,1,1\n",
            None,
            ["CSV, 2 points, x, y, velocities vx, vy, 3 x 4"],
        ),
        (
            "x,y,z\n0,0,-5\n3,4,-5\n",
            None,
            [
                "CSV, 2 points, x, y, z, 3 x 4 x 0",
                "z is constant (-5); for a path in the plane take --columns x,y",
                "z is below the ground; are these north, east, down?",
            ],
        ),
        (
            "x,y,z\n0,0,-5\n3,4,-6\n",
            None,
            [
                "CSV, 2 points, x, y, z, 3 x 4 x 1",
                "z is below the ground; are these north, east, down?",
            ],
        ),
        (
            "0 7 1\n2 7 3\n",
            "0,1,2",
            [
                "text, 2 points, columns 0, 1, 2, 2 x 0 x 2",
                "column 1 is constant (7); for a path in the plane take --columns 0,2",
            ],
        ),
        ("x,y\n0,7\n2,7\n", None, ["CSV, 2 points, x, y, 2 x 0", "y is constant (7)"]),
    ):
        found = read_recording(write(text), columns).messages
        assert found == tuple(f"waypoints.csv: {message}" for message in expected)
        assert max(map(len, found)) < 110


def test_large_coordinates_keep_their_digits(write):
    utm = [[500_000.001, 5_400_000.002], [500_200.003, 5_400_050.004]]
    text = "\n".join(",".join(f"{value:.3f}" for value in row) for row in utm)
    cloud = PointCloud.read(write("easting,northing\n" + text))
    np.testing.assert_array_equal(cloud.points, utm)
    np.testing.assert_allclose(cloud.denormalize(cloud.normalize(utm)), utm, rtol=0, atol=2e-9)


def test_100_000_lines_are_read_exactly(tmp_path):
    points = np.random.default_rng(0).standard_normal((100_000, 2))
    np.savetxt(tmp_path / "many.csv", points, delimiter=",", header="x,y")
    np.testing.assert_array_equal(read_recording(tmp_path / "many.csv").points, points)


DIALECT = st.fixed_dictionaries(
    {
        "sep": st.sampled_from([",", ";", "\t", " "]),
        "decimal": st.sampled_from([".", ","]),
        "header": st.booleans(),
        "index": st.booleans(),
        "lineterminator": st.sampled_from(["\n", "\r\n"]),
        "quoting": st.sampled_from([0, 1]),
    }
)
NUMBERS = st.floats(-1e12, 1e12).map(lambda value: float(f"{value:.12g}"))


@settings(max_examples=60, derandomize=True)
@given(
    points=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=2, max_size=6),
    dialect=DIALECT,
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    dim=st.sampled_from([2, 3]),
)
def test_what_pandas_writes_is_read_back(tmp_path_factory, points, dialect, encoding, dim):
    path = tmp_path_factory.mktemp("dialect") / "table.csv"
    values = np.array(points)
    if dim == 3:
        values = np.c_[values, values[:, 0]]
    frame = pd.DataFrame(values, columns=[*"xyz"[:dim]])
    if dialect["sep"] == " " and dialect["decimal"] == ",":
        dialect = {**dialect, "decimal": "."}
    dialect = {**dialect, "header": dialect["header"] or dialect["index"]}
    frame.to_csv(path, encoding=encoding, **dialect)
    unnamed = list(range(dim)) if not dialect["header"] else None
    np.testing.assert_array_equal(read_recording(path, unnamed).points, values)
