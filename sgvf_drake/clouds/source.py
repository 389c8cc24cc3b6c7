"""The bytes of a file of any kind, in bounded memory, and the text in them.

A file is read up to a limit and never beyond it, so that devices, pipes and compressed files
that never end cost no more than others.
"""

import codecs
import gzip
import io
from pathlib import Path
import re
import zlib

from sgvf_drake.exceptions import PointCloudError

MOST_BYTES = 100_000_000
"""Larger files are refused, as are compressed ones that unpack to more."""

MOST_ROWS = 2_000_000
"""Longer tables are refused: a day at 20 points a second is shorter."""

READABLE = "CSV, text, .npy, .npz, GPX and QGC missions are read"

GZIP, ZIP = b"\x1f\x8b", b"PK\x03\x04"

# Those of UTF-32 come first, as one of them begins with that of UTF-16.
BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF8, "utf-8-sig"),
)

# Whatever no text editor writes; \x1a ends files of DOS.
CONTROL = re.compile(r"[\x00-\x08\x0e-\x19\x1b-\x1f]")


def read_bytes(path: Path) -> bytes:
    """Returns the content of a file, unpacked if it is compressed by gzip.

    Raises:
        PointCloudError: If it cannot be read, or is too large.
    """
    try:
        if path.is_dir():
            raise PointCloudError(f"{path} is a folder, not a file of waypoints")
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except PointCloudError:
        raise
    except FileNotFoundError:
        raise PointCloudError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise PointCloudError(f"{path} cannot be read: {reason}") from error
    if data.startswith(GZIP):
        try:
            data = gzip.GzipFile(fileobj=io.BytesIO(data)).read(MOST_BYTES + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise PointCloudError(f"{path} is no whole gzip file: {error}") from error
    if len(data) > MOST_BYTES:
        raise PointCloudError(
            f"{path} is larger than {MOST_BYTES // 10**6} MB; keep every tenth line, say"
        )
    return data


def decode(path: Path, data: bytes) -> str:
    r"""Returns the text in the bytes of a file, its lines separated by "\n".

    It is UTF-8, or UTF-16 or UTF-32 with a byte order mark, or else Latin-1, which leaves
    numbers as they are and reads the names of columns in most of Europe.

    Raises:
        PointCloudError: If there is no text.
    """
    marked = next((name for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), None)
    try:
        text = data.decode(marked or "utf-8")
    except UnicodeDecodeError as error:
        if marked is not None:
            raise PointCloudError(f"{path} is no whole {marked} text") from error
        text = data.decode("latin-1")
    odd = CONTROL.search(text)
    if odd:
        line = text.count("\n", 0, odd.start()) + 1
        raise PointCloudError(
            f"{path}, line {line}: this is not text, but byte {ord(odd[0])}; {READABLE}"
        )
    return text.rstrip("\x1a").replace("\r\n", "\n").replace("\r", "\n")
