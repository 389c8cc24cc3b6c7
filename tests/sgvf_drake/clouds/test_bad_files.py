"""Files that cannot be used: one line each, which names the file and the place in it."""

import gzip
import io
import json
import os
import threading
import time
import zipfile
import zlib

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.clouds import source
from sgvf_drake.clouds.reading import NUMPY, read_recording
from sgvf_drake.clouds.source import GZIP, ZIP
from sgvf_drake.exceptions import PointCloudError


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def archive(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in members.items():
            made.writestr(name.replace("_npy", ".npy"), content)
    return file.getvalue()


def gpx(inside, more=""):
    return f'<?xml version="1.0"?>\n{more}<gpx>\n<trk><trkseg>{inside}</trkseg></trk></gpx>'


# A header of .npy that promises more than there is.
LYING = npy(np.zeros((2, 2))).replace(b"(2, 2)", b"(9, 2)")
HUGE = npy(np.zeros((2, 2))).replace(b"(2, 2), }" + 9 * b" ", b"(9" + 8 * b"0" + b", 2), }")
assert b"(900000000, 2), }" in HUGE
BOMB = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10 if n else "lol"}">' for n in range(9))
TRACK_OF_ONE = gpx('<trkpt lat="1" lon="2"/>')
MISSION = "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t1\t2\t30\t1\n"

TEXTS = (
    # Fields.
    ("x,y\n1,2\n3,abc\n", None, r"waypoints.csv, line 3: 'abc' is not a number"),
    ("1,2\n\n# pause\n3,\n", None, r"line 4: column 1 is missing"),
    ("x,y\n1,2\n3,nan\n", None, r"line 3: y is missing"),
    ("1,2\n3,4_0\n", None, r"line 2: '4_0' is not a number"),
    ("1,2\n-inf,4\n", None, r"line 2: column 0 is not finite"),
    ("1,2\n3,1e999\n", None, r"line 2: column 1 is not finite"),
    ("x,y,vx,vy\n1,2,3,4\n3,4,inf,5\n", None, r"line 3: vx is not finite"),
    ("x,y,vx,vy\n1,2,3,4\n3,4,fast,5\n", None, r"line 3: 'fast' is not a number"),
    ("x,y\nnan,nan\n,\n", None, "every coordinate is missing"),
    ("1,2\n3,4,5\n", None, r"line 2: 3 fields, not 2"),
    ("x,y\n1\n", None, r"line 2: 1 fields, not 2"),
    ("x,y\n0,1,2\n", None, r"line 2: 3 fields, not 2"),
    ("1,2\n1 2\n", None, r"line 2: 1 fields, not 2"),
    ("1;2\n1,5;2.5\n", None, r"line 2: '2.5' is not a number, as other .* decimal commas"),
    ("x;y\n1.234,5;2,5\n", None, r"line 2: '1.234,5' is not a number"),
    ("x y\n1,5 2,5\n3,5 4,5\n", None, r"line 3: decimal commas, or pairs\? Separate"),
    ("1,5 2,5\n3,5 4,5\n", "0,1", r"line 2: decimal commas, or pairs\?"),
    ("x,y\n1,2\nx,y\n3,4\n", None, r"line 3: 'x' is not a number"),
    ("x,y\n12 m,3 m\n", None, r"line 2: '12 m' is not a number"),
    ("lat,lon\n48 08 12 N,11 34 00 E\n", None, r"line 2: '48 08 12 N' is not a number"),
    ("x,y\n1,2\n3,4", "x,lat", "no column 'lat'; it has columns 'x', 'y'"),
    # Files without rows or columns.
    ("", None, "it is empty"),
    ("\n# nothing\n\n", None, "it is empty"),
    ("\n,,\n ; \n", None, "it is empty"),
    ("x,y\n", None, "only a header"),
    ("x,y\nm,m\n", None, "only a header|'m' is not a number"),
    ("1\n2\n", None, "two columns or more, not 1"),
    ("x\n2\n", None, "two columns or more, not 1"),
    ("There once was a robot\nwhich wrote a poem\n", None, "'There', 'once', 'was'"),
    # Choices.
    ("1,2\n3,4\n", ["x", "y"], "no column 'x'; it has columns 0 to 1, without names"),
    ("x,y\n1,2\n", [0, 2], "no column 2; it has columns 0 to 1"),
    ("x,y\n1,2\n", [0, -1], "no column -1"),
    ("x,y\n1,2\n", ["x", 0], "column 0 is chosen twice"),
    ("x,y\n1,2\n", ["x"], "two columns or more, not 1"),
    ("x,y\n1,2\n", [], "two columns or more, not 0"),
    ("x,x\n1,2\n", ["x", 1], "two columns are named 'x'"),
    ("lat,lon,gps_lat\n1,2,3\n", "0,1,2", "along the same axis"),
    ("x,y\n1,2\n" + "1," * 500_001, None, "line 3: longer than 1,000,000 characters"),
    # Quotes.
    ('x,y\n1,2\n"3,4\n5,6\n', None, "line 3: "),
    ('x,y\n1,2\n"3\n",4\n5,6\n', None, "line 3: a quoted field runs over the end"),
    ('x,y\n"' + "1" * 200_000 + '",2\n', None, "line 2: field larger than field limit"),
    # Encodings, and what is no text.
    (b"x,y\n1,2\n3,\xff\n", None, "line 3: '\xff' is not a number"),
    ("x,y\n1,2\n".encode("utf-16")[:-1], None, "no whole utf-16 text"),
    ("x,y\n1,2\n".encode("utf-16-le"), None, "line 1: this is not text, but byte 0"),
    (b"\x89PNG\x00\x00\x01", None, r"line 1: this is not text.*CSV, text, \.npy"),
    (b"MATLAB 5.0 MAT-file\x00\x01", None, "is not text, but byte 0; CSV, text"),
    (b"1,2\n3,4\n\x07\x00\xff\x10", None, "line 3: this is not text, but byte 7"),
    (pd.DataFrame({"x": [1.0]}).to_parquet(), None, "is not text"),
    (json.dumps({"x": [1, 2]}), None, r"holds JSON; CSV, text, \.npy, \.npz, GPX and QGC"),
    ("[[1, 2], [3, 4]]", None, "holds JSON"),
    # Degrees.
    ("lat,lon\n91,2\n3,4\n", None, "line 2: 91 is no latitude in degrees"),
    ("lat,lon\n1,2\n3,400\n", None, "line 3: 400 is no longitude in degrees"),
    ("lat,lon\n481372000,115756000\n", None, "line 2: 481372000 is no latitude in degrees"),
    ("lat,lon\n48,11\n48.01,11\n0,0\n", None, r"line 4: 0, 0 is 5,\d\d\d km from 48.* N, 11"),
    ("lat,lon\n48,11\n48.01,11\n-48,-169\n", None, "line 4: -48, -169 is 12,7"),
    # Transposed.
    ("\n".join(",".join("1" * 50) for _ in range(2)), None, "2 points in 50-D: transposed"),
)
OTHERS = (
    ("track.gpx", gpx(""), "no track, route or waypoint has any"),
    ("track.gpx", gpx('<trkpt lat="1"/>'), "line 3: lon is missing"),
    ("track.gpx", gpx('<trkpt lat="1" lon="east"/>'), "line 3: 'east' is no lon"),
    ("track.gpx", gpx('<trkpt lat="1" lon="2"><ele>high</ele></trkpt>'), "'high' is no ele"),
    ("track.gpx", gpx('<trkpt lat="inf" lon="2"/>'), "line 3: lat is not finite"),
    ("track.gpx", gpx('<trkpt lat="nan" lon="2"/>'), "line 3: lat is missing"),
    ("track.gpx", gpx('<trkpt lat="1" lon="2"/>')[:-5], "line 3: not well-formed XML"),
    ("track.gpx", gpx("<trkpt>") + "x", "line 3: "),
    ("track.gpx", gpx("&lol;"), "line 3: not well-formed XML: undefined entity"),
    ("track.gpx", gpx("&e8;", f"<!DOCTYPE gpx [{BOMB}]>"), "line 2: XML with a DOCTYPE"),
    ("track.gpx", gpx("", '<!DOCTYPE gpx SYSTEM "file:///dev/zero">'), "with a DOCTYPE"),
    ("track.kml", "<kml><Placemark/></kml>", "line 1: this is XML of 'kml', not of GPX"),
    ("page.html", "<html></html>", "XML of 'html'"),
    ("deep.gpx", "<gpx>" + "<a>" * 200_000, "not well-formed XML"),
    ("m.waypoints", "QGC WPL 110\n", "no item of the mission is one"),
    ("m.waypoints", MISSION, "no item of the mission is one"),
    ("m.waypoints", MISSION + "1\t0\t3\t16\t0\n", "line 3: 5 fields, not 12"),
    ("m.waypoints", MISSION + "1 0 3 16 0 0 0 0 north 2 3 1\n", "line 3: no mission item"),
    ("m.waypoints", MISSION + "1 0 1 16 0 0 0 0 5 2 3 1\n", "line 3: frame 1 of MAVLink"),
    ("m.waypoints", MISSION + "1 0 3 16 0 0 0 0 95 2 3 1\n", "line 3: 95 is no latitude"),
    ("p.npy", b"", r"not a readable \.npy file"),
    ("p.npy", b"x,y\n1,2\n", r"not a readable \.npy file"),
    ("p.npy", npy(np.zeros((100, 2)))[:200], r"not a readable \.npy file"),
    ("p.npy", LYING, r"not a readable \.npy file"),
    ("p.npy", LYING.replace(b"(9, 2)", b"(9, (2"), r"not a readable \.npy file"),
    ("p.npy", HUGE, r"not a readable \.npy file"),
    # Pickles are never loaded.
    ("p.npy", npy(np.array([[1, None]], dtype=object), allow_pickle=True), "not a readable"),
    ("p.npy", npy(np.zeros(4)), r"holds an array \(4,\)"),
    ("p.npy", npy(np.zeros((0, 2))), r"holds an array \(0, 2\)"),
    ("p.npy", npy(np.zeros((3, 2), dtype=complex)), "complex128, not real numbers"),
    ("p.npy", npy(np.array([["a", "b"]])), "not real numbers"),
    ("p.npy", npy(np.array([[1.0, 2], [3, np.nan]])), "row 1: column 1 is missing"),
    ("p.npy", npy(np.array([[1.0, 2], [np.inf, 1]])), "row 1: column 0 is not finite"),
    ("p.npy", npy(np.zeros((4, 4))), "which of its 4 columns without names"),
    ("p.npy", npy(np.zeros((2, 400))), "holds 2 points in 400-D: transposed"),
    ("p.npy", npy(np.zeros((3, 9))), "holds 3 points in 9-D: transposed"),
    ("p.npz", npz(a=np.zeros((3, 2)), b=np.zeros(3)), r"holds 2 arrays \(a, b\)"),
    ("p.npz", npz(), "an archive without arrays|not a readable"),
    ("p.npz", npz(a=np.zeros((3, 2)))[:-30], r"not a readable \.npz file"),
    ("book.xlsx", archive(sheet="<xml/>"), "an archive without arrays; CSV, text"),
    ("p.npz", archive(a_npy=bytes(3_000_000)), "unpacks to more than|not a readable"),
    ("p.csv.gz", gzip.compress(b"1,2\n3,4\n" * 100)[:-20], "no whole gzip file"),
    ("p.csv.gz", b"\x1f\x8b\x08\x00garbage", "no whole gzip file"),
    ("p.csv.gz", gzip.compress(bytes(3_000_000)), "larger than 2 MB"),
    ("p.csv", b"1,2\n" * 600_000, "larger than 2 MB"),
)


def test_bad_files_are_refused_in_one_line(write, monkeypatch):
    cases = [("waypoints.csv", *case) for case in TEXTS]
    cases += [(name, content, None, match) for name, content, match in OTHERS]
    limit = 2_000_000
    for module in ("source", "formats"):
        monkeypatch.setattr(f"sgvf_drake.clouds.{module}.MOST_BYTES", limit)
    for name, content, columns, match in cases:
        path = write(content, name)
        begun = time.process_time()
        with pytest.raises(PointCloudError, match=match) as error:
            read_recording(path, columns)
        assert time.process_time() - begun < 2, name
        message = str(error.value)
        assert message.startswith(str(path)), message
        assert "\n" not in message
        assert len(message) < len(str(path)) + 340


STARTS = [b"", b"x,y\n", b"<gpx>", b"QGC WPL 110\n0\t", NUMPY + b"\x01\x00", ZIP, GZIP, b'"']
FIELDS = st.text(alphabet="0123456789.,;\t \n\r\"'#%/<>=&eE+-_xyznan", max_size=60)


@settings(max_examples=300, derandomize=True)
@given(start=st.sampled_from(STARTS), rest=st.one_of(st.binary(max_size=60), FIELDS))
def test_whatever_is_in_a_file_ends_in_points_or_in_one_line(tmp_path_factory, start, rest):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(start + (rest if isinstance(rest, bytes) else rest.encode()))
    message = None
    try:
        found = read_recording(path)
    except PointCloudError as error:
        message = str(error)
    if message is None:
        assert np.isfinite(found.points).all()
    else:
        assert message.startswith(str(path))
        assert "\n" not in message


def test_places_that_are_no_files_are_refused(tmp_path):
    for path, match in (
        (tmp_path / "missing.csv", "there is no such file"),
        (tmp_path, "is a folder"),
        (tmp_path / "a\0b", "cannot be read"),
        (tmp_path / ("long" * 200), "cannot be read: File name too long"),
    ):
        with pytest.raises(PointCloudError, match=match):
            read_recording(path)
    (tmp_path / "loop.csv").symlink_to(tmp_path / "loop.csv")
    with pytest.raises(PointCloudError, match="cannot be read: Too many levels"):
        read_recording(tmp_path / "loop.csv")


def test_what_never_ends_is_refused_in_bounded_memory(write, monkeypatch):
    # A device that never ends is read up to the limit.
    with pytest.raises(PointCloudError, match="larger than 100 MB"):
        read_recording("/dev/zero")
    # So is a file that unpacks to a thousand times its size.
    bomb = zlib.compressobj(9, zlib.DEFLATED, 31)
    chunk = bytes(10_000_000)
    packed = b"".join([*(bomb.compress(chunk) for _ in range(12)), bomb.flush()])
    assert len(packed) < 200_000
    with pytest.raises(PointCloudError, match="larger than 100 MB"):
        read_recording(write(packed, "bomb.csv.gz"))
    for module in ("text_table", "formats"):
        monkeypatch.setattr(f"sgvf_drake.clouds.{module}.MOST_ROWS", 1000)
    with pytest.raises(PointCloudError, match="line 1001: more than 1,000 rows are not read"):
        read_recording(write("1,2\n" * 1001))
    assert len(read_recording(write("1,2\n3,4\n" * 500)).points) == 1000
    places = '<trkpt lat="1" lon="2"/>' * 1001
    for name, content in (("t.gpx", gpx(places)), ("p.npy", npy(np.zeros((1001, 2))))):
        with pytest.raises(PointCloudError, match=r"more than 1,000 (points|rows) are not"):
            read_recording(write(content, name))
    assert source.MOST_BYTES == 100_000_000


def test_a_pipe_is_read_as_a_file_is(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_text, args=["1,2\n3,4\n"])
    writer.start()
    np.testing.assert_array_equal(read_recording(tmp_path / "pipe").points, [[1, 2], [3, 4]])
    writer.join()
