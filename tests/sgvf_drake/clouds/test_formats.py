"""GPX, missions, trajectories and NumPy's files: what is taken of them, and what is said."""

import gzip

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.clouds.geodesy import east_north_up
from sgvf_drake.clouds.reading import read_recording
from sgvf_drake.exceptions import PointCloudError

ORIGIN = (12.5, -38.25, 0.0)


def lap(num_points=40):
    """One lap of a course, in degrees."""
    t = 2 * np.pi * np.arange(num_points) / num_points
    east, north = 40 * np.cos(t) + 6 * np.cos(3 * t), 22 * np.sin(t) + 4 * np.sin(2 * t)
    latitude = 12.5 + north / 111_000
    return latitude, -38.25 + east / (111_000 * np.cos(np.radians(12.5)))


def gpx(*parts, version="1/1"):
    space = f"http://www.topografix.com/GPX/{version}"
    return f'<?xml version="1.0"?>\n<gpx xmlns="{space}">\n' + "\n".join(parts) + "\n</gpx>\n"


def points(tag, latitude, longitude, more=""):
    return "\n".join(
        f'<{tag} lat="{a:.7f}" lon="{b:.7f}">{more}</{tag}>'
        for a, b in zip(latitude, longitude, strict=True)
    )


def track(*segments):
    inside = "".join(f"<trkseg>{segment}</trkseg>" for segment in segments)
    return f"<trk><name>lap &amp; lap</name>{inside}</trk>"


def mission(latitude, longitude, *more):
    home = "0\t1\t0\t16\t0\t0\t0\t0\t12.6\t-38.3\t30\t1"
    items = [
        f"{number}\t0\t3\t16\t0\t0\t0\t0\t{a:.7f}\t{b:.7f}\t{40 + number % 2}\t1"
        for number, (a, b) in enumerate(zip(latitude, longitude, strict=True), start=1)
    ]
    return "\n".join(["QGC WPL 110", home, *items, *more]) + "\n"


def test_degrees_of_every_format_become_the_same_metres(write):
    latitude, longitude = lap()
    exact = east_north_up(latitude, longitude, np.zeros(40), ORIGIN)[:, :2]
    table = "\n".join(f"{a:.7f},{b:.7f},31" for a, b in zip(latitude, longitude, strict=True))
    there = "about 12.50000 N, 38.25000 W, 92.3 m x 46.4 m"
    jump = "41\t0\t3\t177\t1\t-1\t0\t0\t0\t0\t0\t1"
    speed = "42\t0\t3\t178\t1\t5\t0\t0\t0\t0\t0\t1"
    leave = "take it with --columns lat,lon,"
    for name, content, first, *others in (
        ("gps.csv", "lat,lon,alt\n" + table, "CSV, 40 points", f"alt left out; {leave}alt"),
        (
            "track.gpx",
            gpx(track(points("trkpt", latitude, longitude, "<ele>31.5</ele><time/>"))),
            "GPX track, 40 points",
            f"ele left out; {leave}ele",
        ),
        (
            "route.gpx",
            gpx("<rte>" + points("rtept", latitude, longitude) + "</rte>", version="1/0"),
            "GPX route, 40 points",
        ),
        (
            "bare.xml",
            "<gpx>" + points("wpt", latitude, longitude) + "</gpx>",
            "GPX waypoints, 40 points",
        ),
        (
            "mission.waypoints",
            mission(latitude, longitude, jump, speed),
            "QGC mission, 40 points",
            "left out: home, 1 jump, 1 other command",
            f"alt left out; {leave}alt",
        ),
    ):
        path = write(content, name)
        found = PointCloud.read(path)
        assert found.origin == ORIGIN
        np.testing.assert_allclose(found.points, exact, atol=0.02)
        said = f"{name}: {first}, lat, lon to metres east, north {there}"
        assert found.messages == (said, *(f"{name}: {other}" for other in others))
        # About another origin it is the same place.
        moved = PointCloud.read(path, origin=(12.501, -38.25, 0.0))
        np.testing.assert_allclose(moved.points, found.points - [0, 110.62], atol=0.02)
    # The names in other words, and other orders.
    path = write(table.replace(",31", ""), "bare.csv")
    np.testing.assert_allclose(read_recording(path).points[:, 0], latitude, atol=1e-7)
    for header in (
        "Latitude,Longitude,x1",
        "field.latitude,field.longitude_deg,n",
        "LAT [deg],LNG [deg],s",
    ):
        path = write(header + "\n" + table)
        np.testing.assert_allclose(PointCloud.read(path).points, exact, atol=0.02)
        for columns in ("1,0", [0, 1]):
            np.testing.assert_allclose(PointCloud.read(path, columns).points, exact, atol=0.02)


def test_altitude_is_taken_where_it_is_chosen(write):
    latitude, longitude = lap()
    path = write(mission(latitude, longitude), "mission.txt")
    for columns in ("lat,lon,alt", "alt,lon,lat", "0,1,2"):
        found = read_recording(path, columns)
        height = 40 + np.arange(1, 41) % 2
        expected = east_north_up(latitude, longitude, height, ORIGIN)
        np.testing.assert_allclose(found.points, expected, atol=0.02)
        assert "east, north, up about 12.50000 N" in found.messages[0]
        assert len(found.messages) == 2


def test_a_track_over_the_antimeridian_and_one_at_the_pole(write):
    for latitude, longitude in (
        (np.linspace(-17, -16.99, 5), np.array([179.998, 179.999, 180, -179.999, -179.998])),
        (np.full(6, 89.99), np.arange(6) * 60.0),
    ):
        path = write(gpx(track(points("trkpt", latitude, longitude))), "far.gpx")
        found = read_recording(path)
        assert np.ptp(found.points, axis=0).max() < 2500
        steps = np.linalg.norm(np.diff(found.points, axis=0), axis=1)
        np.testing.assert_allclose(steps, steps[0], rtol=2e-3)


def test_segments_of_a_track_are_pieces_and_the_rest_is_said(write):
    latitude, longitude = lap()
    half = [
        points("trkpt", latitude[part], longitude[part]) for part in (slice(20), slice(20, 40))
    ]
    alone = points("wpt", latitude[:3], longitude[:3], "<name>a stop</name>")
    for content in (
        gpx(alone, track(*half)),
        gpx(alone, track(half[0]), track("", half[1], "")),
    ):
        found = read_recording(write(content, "two.gpx"))
        assert (len(found.points), found.breaks) == (40, (20,))
        assert ", 40 points in 2 pieces, " in found.messages[0]
        assert found.messages[1:] == ("two.gpx: left out: 3 points of its waypoints",)


def test_trajectories_are_known_by_their_columns(write):
    rng = np.random.default_rng(0)
    places = rng.standard_normal((9, 3)).round(4)
    quaternions = rng.standard_normal((9, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    tum = np.c_[1.7e9 + np.arange(9), places, quaternions]
    rotations = np.linalg.qr(rng.standard_normal((9, 3, 3)))[0]
    rotations[:, :, 0] *= np.linalg.det(rotations)[:, None]
    kitti = np.concatenate([rotations, places[:, :, None]], axis=2).reshape(9, 12)
    for values, kind, others in (
        (tum, "TUM trajectory", [1, 2]),
        (kitti, "KITTI poses", [3, 7]),
    ):
        text = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in values)
        found = read_recording(write(text, "poses.txt"))
        np.testing.assert_allclose(found.points, places, atol=1e-6)
        assert found.messages[0].startswith(f"poses.txt: {kind}, 9 points, x, y, z, ")
        assert len(found.messages) == 1 + (kind == "KITTI poses")
        for columns in ("x,y", others):
            chosen = read_recording(write(text, "poses.txt"), columns)
            np.testing.assert_allclose(chosen.points, places[:, :2], atol=1e-6)
        # Without the right length or the right angles, they are columns like others.
        longer = values * np.where(np.arange(9) == 4, 1.5, 1)[:, None]
        text = "\n".join(",".join(map(str, row)) for row in longer)
        with pytest.raises(PointCloudError, match="columns without names"):
            read_recording(write(text, "poses.txt"))
    # Axes of the wrong hand, at right angles as they are, are of no rotation.
    mirrored = kitti * np.where(np.isin(np.arange(12), (0, 4, 8)), -1, 1)
    text = "\n".join(",".join(map(str, row)) for row in mirrored)
    with pytest.raises(PointCloudError, match="columns without names"):
        read_recording(write(text, "poses.txt"))
    # A comment that names the columns comes first.
    text = "# timestamp tx ty tz qx qy qz qw\n0 1 2 3 9 9 9 9\n1 4 5 6 9 9 9 9\n"
    np.testing.assert_array_equal(read_recording(write(text)).points, [[1, 2, 3], [4, 5, 6]])


def test_numpy_files(tmp_path, write):
    path = tmp_path / "points.npy"
    for dtype in (np.float64, np.float32, np.int16, ">f4"):
        values = np.arange(8).reshape(4, 2).astype(dtype)
        np.save(path, np.asfortranarray(values))
        assert read_recording(path).points.dtype == np.float64
        np.testing.assert_array_equal(read_recording(path).points, values)
        np.testing.assert_array_equal(read_recording(path, [1, 0]).points, values[:, ::-1])
    gap = np.array([[0, 1], [2, 3], [np.nan, np.nan], [4, 5], [6, 7.0]])
    np.save(path, gap)
    assert read_recording(path).breaks == (2,)
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "points.npz", track=gap)
        found = read_recording(tmp_path / "points.npz")
        np.testing.assert_array_equal(found.points, gap[[0, 1, 3, 4]])
    assert found.messages == (
        "points.npz: NumPy array, 4 points in 2 pieces, columns 0, 1, 6 x 6",
    )
    packed = write(gzip.compress(path.read_bytes()), "points.npy.gz")
    np.testing.assert_array_equal(read_recording(packed).points, gap[[0, 1, 3, 4]])
