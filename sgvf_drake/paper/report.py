"""One page of what experiments found: verdicts, figures and tables, in a single HTML file.

It needs no other file, and no script.  Numbers are told in three digits, with intervals beside
their means, and pictures are small.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
import io
import math
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
import numpy as np
import pandas as pd
from pandas.api.types import is_bool_dtype, is_numeric_dtype
from PIL import Image

from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.scenario import SCENARIO_FILE, stored_summary

TEMPLATE, STYLE = "report.html", "report.css"
SYMBOLS = {Verdict.HOLDS: "holds", Verdict.PARTLY: "partly", Verdict.FAILS: "fails"}
"""What the style sheet and the symbols on the page call the verdicts."""

THUMBNAIL = (360, 240)
"""Pixels, at most."""
EXACT_BYTES = 150_000
"""What a picture may have with every pixel as it is; beyond, it is compressed with loss."""

DIGITS = 3
# What is smaller or not smaller than these is written with a power of ten.
SMALLEST, LARGEST = 1e-3, 1e6
MISSING, MINUS, TIMES = "\N{EN DASH}", "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Characters from which a text needs width.
PROSE = 50
MEAN, LOW, HIGH = " mean", " low", " high"


def build_page(summary: Mapping[str, Any], folder: Path) -> str:
    """Returns the report of a reproduction in a folder, as an HTML file, by its summary."""
    loader = PackageLoader("sgvf_drake.paper")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    option = " --override quick" if summary["quick"] else ""
    sections = [
        {
            **{"name": name, "command": f"sgvf run {name}{option} --out {name}"},
            **entry,
            **_result(folder / name, entry["status"]),
        }
        for name, entry in summary["scenarios"].items()
    ]
    return environment.get_template(TEMPLATE).render(
        # The style sheet is ours; everything else is escaped.
        style=Markup(loader.get_source(environment, STYLE)[0]),
        sections=sections,
        symbols=SYMBOLS,
        time=duration_text(summary["trial_s"]),
        wall=duration_text(summary["wall_s"]),
        summary=summary,
    )


def _result(folder: Path, status: str) -> dict[str, Any]:
    """Returns what is shown of the result of a scenario; it is empty where there is none."""
    summary = stored_summary(folder) if status in ("done", "outdated") else None
    if summary is None:
        return {"claims": [], "exhibits": [], "thumbnail": None, "facts": {}, "scenario": ""}
    exhibits = [
        {
            "caption": one["caption"],
            **(
                {"picture": embed(folder / one["file"])}
                if one["file"].endswith(".png")
                else {"table": read_table(folder / one["file"])}
            ),
        }
        for one in summary["exhibits"]
    ]
    pictures = [one["file"] for one in summary["exhibits"] if one["file"].endswith(".png")]
    seeds = summary["seeds"]
    facts = {
        "Seeds" if len(seeds) > 1 else "Seed": ", ".join(map(str, seeds)) or "none",
        "Trials": duration_text(summary["trial_s"]),
        "Last run": duration_text(summary["wall_s"]),
    }
    return {
        "claims": summary["claims"],
        "exhibits": exhibits,
        "thumbnail": embed(folder / pictures[0], thumbnail=True) if pictures else None,
        "facts": facts | ({"Commit": summary["commit"]} if summary["commit"] else {}),
        "scenario": (folder / SCENARIO_FILE).read_text(encoding="utf-8"),
    }


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


@dataclass(frozen=True)
class Table:
    """A table on the page.

    Attributes:
        columns: What each column holds, with the unit, and what it is to the style sheet:
            "number", "prose" for long sentences, or "" for words.
        rows: The texts of the cells.
        intervals: Whether there are means with their intervals in it.
    """

    columns: list[tuple[str, str]]
    rows: list[tuple[str, ...]]
    intervals: bool


def read_table(path: Path) -> Table:
    """Reads a table of a result; only an empty cell has no value, the text "None" is one."""
    return view_table(pd.read_csv(path, keep_default_na=False, na_values=[""]))


def view_table(table: pd.DataFrame) -> Table:
    """Returns a table as it is shown; "X mean", "X low" and "X high" become one column X."""
    columns: list[tuple[str, str]] = []
    cells: list[list[str]] = []
    intervals = False
    stems = [str(name).removesuffix(MEAN) for name in table if str(name).endswith(MEAN)]
    whole = [stem for stem in stems if stem + LOW in table and stem + HIGH in table]
    for name in map(str, table.columns):
        stem, kind = name.removesuffix(MEAN), ""
        if name in [end for one in whole for end in (one + LOW, one + HIGH)]:
            continue
        if stem != name and stem in whole:
            parts = zip(table[name], table[stem + LOW], table[stem + HIGH], strict=True)
            texts = [interval_text(*map(float, values)) for values in parts]
            intervals |= any(text.endswith("]") for text in texts)
            kind = "number"
        else:
            stem, texts = name, [cell_text(value) for value in table[name]]
            if is_numeric_dtype(table[name]) and not is_bool_dtype(table[name]):
                kind = "number"
            elif any(len(text) > PROSE for text in texts):
                kind = "prose"
        columns.append((stem, kind))
        cells.append(texts)
    return Table(columns, list(zip(*cells, strict=True)), intervals)


def cell_text(value: object) -> str:
    """Returns a value of a table: numbers in three digits, no value as a dash."""
    match value:
        case bool() | np.bool_():
            return "yes" if value else "no"
        case str():
            return value
        case int() | np.integer():
            return _signed(f"{int(value):,}")
        case float() | np.floating():
            return number_text(float(value))
    return MISSING if value is None or pd.isna(value) else str(value)  # type: ignore[call-overload]


def number_text(value: float) -> str:
    """Returns a number in three significant digits; a whole one without decimals."""
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return _signed(f"{value:+}").replace("inf", "∞").lstrip("+")
    if value.is_integer() and abs(value) < LARGEST:
        return _signed(f"{int(value):,}")
    return _signed(_fixed(value, abs(value)))


def interval_text(mean: float, low: float, high: float) -> str:
    """Returns "0.93 [0.80, 1.00]", all with the decimals of the largest."""
    if math.isnan(low) or math.isnan(high):
        return number_text(mean)
    values = (mean, low, high)
    largest = max(map(abs, values))
    if all(value.is_integer() for value in values):
        texts = [number_text(value) for value in values]
    else:
        texts = [_signed(_fixed(value, largest)) for value in values]
    return f"{texts[0]} [{texts[1]}, {texts[2]}]"


def duration_text(seconds: float) -> str:
    """Returns a time as "8.2 s", "12 min 5 s" or "1 h 3 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes == 0:
        return f"{rest} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def _fixed(value: float, largest: float) -> str:
    """A number with as many decimals as give the largest one three digits."""
    if not SMALLEST <= largest < LARGEST:
        mantissa, _, exponent = f"{value:.{DIGITS - 1}e}".partition("e")
        power = str(int(exponent)).translate(_SUPERSCRIPTS)
        return f"{mantissa}{TIMES}10{power}" if value else "0"
    # Rounded first: 0.9996 is 1.00.
    rounded = float(f"{largest:.{DIGITS - 1}e}")
    decimals = max(DIGITS - 1 - math.floor(math.log10(rounded)), 0)
    text = f"{value:,.{decimals}f}"
    return text.lstrip("-") if float(text.replace(",", "")) == 0 else text


def _signed(text: str) -> str:
    return text.replace("-", MINUS, 1) if text.startswith("-") else text
