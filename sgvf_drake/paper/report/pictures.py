"""Pictures for a page that needs no other file: small, and as they were drawn."""

import base64
from functools import lru_cache
import io
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

THUMBNAIL = (360, 240)
"""Pixels, at most."""
EXACT_BYTES = 150_000
"""What a picture may have with every pixel as it is; beyond, it is compressed with loss."""


class Embedded(NamedTuple):
    """A picture as the page holds it: its content as an address, and its size in pixels."""

    source: str
    width: int
    height: int


def embed(path: Path, *, thumbnail: bool = False) -> Embedded:
    """Returns a picture, in about a third of the bytes of its PNG file or as a thumbnail."""
    return _embedded(path.read_bytes(), thumbnail)


# The page is built after every scenario, and encoding its pictures takes most of the time.
@lru_cache(maxsize=256)
def _embedded(content: bytes, thumbnail: bool) -> Embedded:
    with Image.open(io.BytesIO(content)) as file:
        picture = file.convert("RGB")
    if thumbnail:
        picture.thumbnail(THUMBNAIL, Image.Resampling.LANCZOS)
        encoded = _encoded(picture, quality=80)
    else:
        # More effort takes longer and does not make figures smaller.
        encoded = _encoded(picture, lossless=True, method=1)
    if len(encoded) > EXACT_BYTES:
        # At this quality the loss is not seen.
        encoded = min(encoded, _encoded(picture, quality=90, use_sharp_yuv=True), key=len)
    text = base64.b64encode(encoded).decode("ascii")
    return Embedded(f"data:image/webp;base64,{text}", *picture.size)


def _encoded(picture: Image.Image, **options: Any) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, format="WEBP", **options)
    return stream.getvalue()
