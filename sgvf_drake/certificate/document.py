"""JSON files of what was proved: written whole or not at all, refused if they were changed."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
import hashlib
from itertools import chain
import json
import math
from pathlib import Path
from typing import Any, ClassVar, Self

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.storage import write_whole


@dataclass(frozen=True)
class Document:
    """A dataclass that is kept as a JSON file, with the digest of what it holds.

    Attributes:
        FORMAT: The name of the kind of file.
        VERSION: The version of it that is written, and read.
    """

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes it as JSON, whole or not at all.

        Raises:
            OutputExistsError: The file exists and `overwrite` is false.
            OSError: The folder does not exist or cannot be written.
        """
        write_whole(Path(path), self.to_json().encode(), overwrite=overwrite)

    def to_json(self) -> str:
        """Returns the text of the file, a line for each key; its digest is that of the rest."""
        body = asdict(self)
        head = {"format": self.FORMAT, "version": self.VERSION, "digest": _digest(body)}
        lines = (
            f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)}"
            for key, value in (head | body).items()
        )
        return "{\n" + ",\n".join(lines) + "\n}\n"

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a file.

        Raises:
            ConfigurationError: The file is missing, damaged, foreign or of another version, or
                anything in it was changed.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{path}: cannot be read ({error})") from None
        try:
            return cls.from_json(text)
        except ConfigurationError as error:
            raise ConfigurationError(f"{path}: {error}") from None

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Returns what a text of `to_json` says; see `load`."""
        try:
            body = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigurationError(f"no JSON document ({error})") from None
        if not isinstance(body, dict) or body.pop("format", None) != cls.FORMAT:
            raise ConfigurationError(f"not a file of the format {cls.FORMAT}")
        if (version := body.pop("version", None)) != cls.VERSION:
            raise ConfigurationError(
                f"a certificate of version {version}, not of {cls.VERSION}: certify the field "
                "anew"
            )
        if body.pop("digest", None) != _digest(body):
            raise ConfigurationError("the certificate was changed after it was written")
        names = {field.name for field in fields(cls)}
        if set(body) != names:
            raise ConfigurationError(f"not a whole certificate ({sorted(names ^ set(body))})")
        try:
            return cls._of(body)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigurationError(f"not a whole certificate ({error})") from None

    @classmethod
    def _of(cls, body: Mapping[str, Any]) -> Self:
        """Returns what a JSON object with all keys says."""
        raise NotImplementedError


def bounds_hold(
    mine: Any,
    claimed: Any,
    at_least: Iterable[str],
    at_most: Iterable[str],
    tolerance: float,
) -> bool:
    """Whether bounds are as strong as those that are claimed, but for a relative tolerance.

    Args:
        mine: What is proved.
        claimed: What is claimed, of the same type.
        at_least: The names of lower bounds: numbers, tuples of them, or None.
        at_most: Those of upper bounds.
        tolerance: What rounding may change: on other machines the last bits differ.
    """
    lower = ((getattr(mine, name), getattr(claimed, name)) for name in at_least)
    upper = ((getattr(claimed, name), getattr(mine, name)) for name in at_most)
    return all(_is_at_least(a, b, tolerance) for a, b in chain(lower, upper))


def _is_at_least(a: Any, b: Any, tolerance: float) -> bool:
    """Whether a number, or each of some, is as large as another, but for a tolerance."""
    if isinstance(a, tuple):
        pairs = zip(a, b, strict=False)
        return len(a) == len(b) and all(_is_at_least(*pair, tolerance) for pair in pairs)
    return (a is None) == (b is None) and (a is None or a >= b - tolerance * math.fabs(b))


def _digest(body: Mapping[str, Any]) -> str:
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
