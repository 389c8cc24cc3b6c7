"""Numbers and tables as people read them: three digits, and intervals beside their means."""

from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
import pandas as pd
from pandas.api.types import is_bool_dtype, is_numeric_dtype

DIGITS = 3
# What is smaller or not smaller than these is written with a power of ten.
SMALLEST, LARGEST = 1e-3, 1e6
MISSING, MINUS, TIMES = "\N{EN DASH}", "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Characters from which a text needs width.
PROSE = 50
MEAN, LOW, HIGH = " mean", " low", " high"


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
