"""Tables in text: CSV and its dialects, and columns separated by spaces.

The first lines tell the dialect; the numbers are read line by line, so that no more than the
text and the chosen columns is ever in memory.
"""

from array import array
from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass
import itertools
import math
from pathlib import Path
import re

import numpy as np

from sgvf_drake.clouds.source import MOST_ROWS
from sgvf_drake.clouds.tables import Rows, Table
from sgvf_drake.exceptions import PointCloudError

SAMPLE = 3
"""Lines that tell the delimiter: names, units and the first numbers."""

LONGEST_LINE = 1_000_000
"""Lines with more characters are refused."""

SAMPLED_ROWS = 50
"""Rows in which decimal commas are looked for."""

KINDS = {";": "text with semicolons", "\t": "text with tabs", ",": "CSV", None: "text"}
"""The delimiters, in the order in which they are looked for, and what a file is then called;
a comma beside one of the first two is a decimal comma."""

MISSING = {"", "-", "nan", "na", "n/a", "null", "none"}
"""Fields that say that there is no number, in small letters."""

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)

UNIT = re.compile(
    r"\[.*\]|\(.*\)|[munµ]?s|sec|[mck]?m|ft|deg(rees?)?|rad|°|[a-zµ°]+/[a-z]+(\^?2)?|[-%]|",
    re.IGNORECASE,
)
"""Fields of a line of units below the names."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TextTable(Table):
    """A table in text.

    Attributes:
        text: All of it.
        delimiter: What separates the fields; None: spaces.
        first: The number of the first line with numbers.
    """

    text: str
    delimiter: str | None
    first: int

    def numbers(self, columns: Sequence[int]) -> Rows:
        commas = self._has_decimal_commas(columns)
        values, places, breaks = array("d"), array("q"), []
        blank = False
        for line, fields in self._rows():
            if not any(fields):
                blank = True
                continue
            if len(fields) != self.num_columns:
                self._check_width(line, fields)
            if blank and places:
                breaks.append(len(places))
            blank = False
            for column in columns:
                try:
                    values.append(_number(fields[column], commas))
                except ValueError:
                    raise self._no_number(fields[column], line, commas) from None
            places.append(line)
            if len(places) > MOST_ROWS:
                raise self.error(
                    f"more than {MOST_ROWS:,} rows are not read; keep every tenth, say", line
                )
        shape = len(places), len(columns)
        return Rows(np.array(values).reshape(shape), np.array(places, dtype=np.intp), breaks)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        lines = (
            (line, content)
            for line, content, _ in _contents(self.path, self.text)
            if line >= self.first and content is not None
        )
        return _split(self, lines, self.delimiter)

    def _has_decimal_commas(self, columns: Sequence[int]) -> bool:
        sample = itertools.islice(self._rows(), SAMPLED_ROWS)
        fields = (row[column] for _, row in sample for column in columns if column < len(row))
        return any(DECIMAL_COMMA.fullmatch(field) for field in fields)

    def _check_width(self, line: int, fields: list[str]) -> None:
        width = self.num_columns
        if len(fields) < width or any(fields[width:]):
            raise self.error(f"{len(fields)} fields, not {width}", line)

    def _no_number(self, field: str, line: int, commas: bool) -> PointCloudError:
        hint = ", as other numbers have decimal commas" if commas and "." in field else ""
        return self.error(f"{field!r} is not a number{hint}", line)


def parse_text(path: Path, text: str) -> TextTable:
    """Finds the dialect of a table in text, and the names of its columns.

    Blank lines may separate pieces.  Comments (from "#", or lines that begin with "%" or
    "//") are skipped.  Names come from a first line without any number, or else from the last
    comment before the data, if it has as many fields as the data; units from a second line
    without any number.

    Raises:
        PointCloudError: If there are no rows.
    """
    lines, comment = _head(path, text)
    if not lines:
        raise PointCloudError(f"{path} holds no waypoints: it is empty")
    delimiter = _delimiter([content for _, content in lines])
    line, last = lines[-1]
    spaced = len(last.split()) > 1 and all(map(_is_number, last.split()))
    if delimiter == "," and "," in last and spaced:
        raise PointCloudError(
            f"{path}, line {line}: decimal commas, or pairs? Separate columns by semicolons"
        )
    bare = TextTable(path, KINDS[delimiter], None, 0, text=text, delimiter=delimiter, first=0)
    head = next(_split(bare, lines[:1], delimiter))[1]
    names, units, start = _names(bare, lines, head)
    if names is None and comment:
        names = _comment_names(bare, comment, len(_trimmed(head)))
    if start >= len(lines):
        raise PointCloudError(f"{path} holds no waypoints: it has only a header")
    first, content = lines[start]
    fields = next(_split(bare, [(first, content)], delimiter))[1]
    if names is not None and delimiter is None and len(names) != len(fields):
        # Units beside the names: "X [m] Y [m]".
        names = re.sub(r"\s+(?=[\[(])", "", lines[0][1]).split()
        if len(names) == len(fields) - 1 and lines[0][1][:1].isspace():
            # The first column has no name, as the index that pandas writes.
            names = ["", *names]
    if names is not None and (not fields[-1] or len(fields) < len(names)):
        names = _trimmed(names)
    return TextTable(
        path,
        KINDS[delimiter],
        names,
        len(names or _trimmed(fields)),
        units,
        text=text,
        delimiter=delimiter,
        first=first,
    )


def _contents(path: Path, text: str) -> Iterator[tuple[int, str | None, str]]:
    """The number of each line, its content (None: only a comment), and its comment."""
    begin, line, end = 0, 0, 0
    while end >= 0:
        end = text.find("\n", begin)
        raw = text[begin:] if end < 0 else text[begin:end]
        begin, line = end + 1, line + 1
        if len(raw) > LONGEST_LINE:
            raise PointCloudError(
                f"{path}, line {line}: longer than {LONGEST_LINE:,} characters"
            )
        # A "#" inside quotes belongs to a name, so a line with quotes has no comment.
        content, comment = raw, ""
        if "#" in raw and '"' not in raw:
            content, _, comment = raw.partition("#")
        if content.lstrip().startswith(("%", "//")):
            content, comment = "", content.strip().lstrip("%/")
        if line == 1 and re.fullmatch(r"sep=.\s*", content):
            # What a spreadsheet tells another one.
            content = ""
        yield line, (content if content.strip() or content == raw else None), comment


def _head(path: Path, text: str) -> tuple[list[tuple[int, str]], str]:
    """The first lines with content, and the last comment in front of them."""
    head: list[tuple[int, str]] = []
    last = ""
    for line, content, comment in _contents(path, text):
        if content is None and not head:
            last = comment
        elif content is not None and content.strip(" \t,;"):
            head.append((line, content))
            if len(head) == SAMPLE:
                break
    return head, last


def _delimiter(lines: Sequence[str]) -> str | None:
    """What separates the fields, as all of the lines show, or else the last of them."""
    plain = [re.sub(r'"[^"]*"', "", line) for line in lines]
    last = plain[-1]
    # Tabs that only align numbers, among spaces or behind commas, are no delimiters.
    numbers = last == lines[-1] and all(map(_is_number, last.split()))
    if numbers and any(len(field.split()) > 1 for field in last.split("\t")) and "\t" in last:
        return None
    aligns = re.search(r",\s*\t|\t\s*,", last) is not None
    for some in (plain, plain[-1:], plain[:1]):
        for mark in (mark for mark in KINDS if mark):
            if all(mark in line for line in some) and not (mark == "\t" and aligns):
                return mark
    return None


def _split(
    table: TextTable,
    lines: Iterator[tuple[int, str]] | Sequence[tuple[int, str]],
    delimiter: str | None,
) -> Iterator[tuple[int, list[str]]]:
    """Splits lines into their fields, without the spaces around them."""
    if '"' not in table.text:
        for line, content in lines:
            if delimiter is None:
                yield line, content.split()
            else:
                yield line, [field.strip() for field in content.split(delimiter)]
        return
    begun: list[int] = []

    def fed() -> Iterator[str]:
        for line, content in lines:
            begun.append(line)
            yield content.strip() if delimiter is None else content

    reader = csv.reader(fed(), delimiter=delimiter or " ", skipinitialspace=True, strict=True)
    try:
        for row in reader:
            if len(begun) > 1:
                raise csv.Error("a quoted field runs over the end of the line")
            yield begun.pop(), [field.strip() for field in row]
    except csv.Error as error:
        raise table.error(str(error), begun[0]) from error


def _names(
    bare: TextTable, lines: Sequence[tuple[int, str]], head: list[str]
) -> tuple[list[str] | None, dict[int, str], int]:
    """The names of the columns, their units, and which of the lines has the first numbers."""
    below = next(_split(bare, lines[1:2], bare.delimiter), (0, []))[1]
    counted = [str(number) for number in range(len(head))]
    # What pandas writes for an array without names: its index in front, or not.
    indexed = len(head) > 1 and head == ["", *counted[:-1]]
    if not indexed and any(_is_number(field) for field in head):
        counts = head == counted and len(below) > 0 and all("." in field for field in below)
        return None, {}, int(counts)
    if any(below) and all(UNIT.fullmatch(f) and not _is_number(f) for f in below):
        return head, {number: f.strip("[]() ") for number, f in enumerate(below)}, 2
    return head, {}, 1


def _comment_names(bare: TextTable, comment: str, width: int) -> list[str] | None:
    """The names in a comment, if they are as many as the columns."""
    text = comment.replace('"', "")
    for delimiter in (bare.delimiter, _delimiter([text]), None):
        fields = text.split() if delimiter is None else text.split(delimiter)
        fields = [field.strip() for field in fields]
        if len(fields) == width and not any(_is_number(field) for field in fields):
            return fields
    return None


def _trimmed(fields: list[str]) -> list[str]:
    """Fields without the empty ones at the end, which trailing delimiters make."""
    while len(fields) > 1 and not fields[-1]:
        fields = fields[:-1]
    return fields


def _is_number(field: str) -> bool:
    try:
        float(field.replace("_", "?"))
    except ValueError:
        return DECIMAL_COMMA.fullmatch(field) is not None
    return True


def _number(field: str, commas: bool) -> float:
    """Reads a number, or NaN where there is none."""
    try:
        # Python reads 1_000 as a number; in a file it is more likely a damaged line.
        if "_" in field or (commas and "." in field):
            raise ValueError(field)
        return float(field)
    except ValueError:
        if commas and DECIMAL_COMMA.fullmatch(field):
            return float(field.replace(",", "."))
        if field.lower() in MISSING:
            return math.nan
        raise
