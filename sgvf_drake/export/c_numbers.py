"""Numbers as C reads them: exactly, and stored as small as a precision allows."""

from collections.abc import Sequence
from dataclasses import dataclass
import re
import textwrap
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray

PRECISIONS = ("mixed", "double", "float")
"""Mixed: stored as float where nothing is lost by it, and computed in double."""

BYTES = {"double": 8, "float": 4, "unsigned char": 1}
LINE_LENGTH = 100


@dataclass(frozen=True)
class CArray:
    """A constant array.

    Attributes:
        name: Its name.
        type: That of its entries.
        values: The entries, by rows.
    """

    name: str
    type: str
    values: np.ndarray

    @property
    def size(self) -> int:
        """The number of entries."""
        return int(self.values.size)

    @property
    def num_bytes(self) -> int:
        """What it takes."""
        return BYTES[self.type] * self.size

    @property
    def text(self) -> str:
        """The entries between the braces."""
        entries = ", ".join(_entry(value, self.type) for value in self.values.ravel())
        return textwrap.fill(
            entries,
            LINE_LENGTH,
            initial_indent="    ",
            subsequent_indent="    ",
            break_long_words=False,
            break_on_hyphens=False,
        )


def storage_type(precision: str, arrays: Sequence[FloatArray]) -> str:
    """Returns the type as which arrays that belong together are stored, float or double."""
    if precision != "mixed":
        return precision
    exact = all(np.array_equal(array, array.astype(np.float32)) for array in arrays)
    return "float" if exact else "double"


def literal(value: float, type: str = "double") -> str:
    """Returns a number as a constant: the shortest decimals that are read as it."""
    return repr(float(value)) + ("f" if type == "float" else "")


def _entry(value: Any, type: str) -> str:
    if type not in ("double", "float"):
        return str(int(value))
    # Hexadecimal, so that no compiler has to round; less the zeros at the end.
    number = float(np.float32(value)) if type == "float" else float(value)
    return re.sub(r"\.?0*p", "p", number.hex()) + ("f" if type == "float" else "")
