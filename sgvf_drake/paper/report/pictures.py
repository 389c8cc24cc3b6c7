"""Pictures for a page that needs no other file: small, and as they were drawn."""

import base64
from collections.abc import Mapping
from functools import lru_cache
import io
from pathlib import Path
from typing import NamedTuple

from PIL import Image

THUMBNAIL = (360, 240)
"""Pixels, at most."""
EXACT_BYTES = 150_000
"""What a picture may have with every pixel as it is; beyond, it is compressed with loss."""
# Of the encoder.  More effort takes longer and does not make figures smaller; at this quality
# the loss is not seen.
EXACT = {"lossless": True, "method": 1}
CLOSE = {"quality": 90, "use_sharp_yuv": True}
THUMB = {"quality": 80}


class Embedded(NamedTuple):
    """A picture as the page holds it: its content as an address, and its size in pixels."""

    source: str
    width: int
    height: int


def embed(path: Path) -> Embedded:
    """Returns a picture in its full size, in about a third of the bytes of its PNG file."""
    return _embedded_file(path.read_bytes())


def embed_thumbnail(path: Path) -> Embedded:
    """Returns a picture reduced to `THUMBNAIL`."""
    picture = _opened(path.read_bytes())
    picture.thumbnail(THUMBNAIL, Image.Resampling.LANCZOS)
    return _embedded(picture, _encoded(picture, THUMB))


# The page is built after every scenario, and encoding its pictures takes most of the time.
@lru_cache(maxsize=256)
def _embedded_file(content: bytes) -> Embedded:
    picture = _opened(content)
    encoded = _encoded(picture, EXACT)
    if len(encoded) > EXACT_BYTES:
        encoded = min(encoded, _encoded(picture, CLOSE), key=len)
    return _embedded(picture, encoded)


def _embedded(picture: Image.Image, encoded: bytes) -> Embedded:
    text = base64.b64encode(encoded).decode("ascii")
    return Embedded(f"data:image/webp;base64,{text}", *picture.size)


def _opened(content: bytes) -> Image.Image:
    with Image.open(io.BytesIO(content)) as file:
        picture = file.convert("RGBA")
    # Where it is transparent, the page would show through, dark or light.
    white = Image.new("RGBA", picture.size, "white")
    return Image.alpha_composite(white, picture).convert("RGB")


def _encoded(picture: Image.Image, options: Mapping[str, bool | int]) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, format="WEBP", **options)
    return stream.getvalue()
