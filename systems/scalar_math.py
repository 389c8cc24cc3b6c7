"""Elementary functions for float, for AutoDiffXd and in compiled code.

A law written with these, on plain scalars, has one source for three uses: marked with
`compilable` it runs as it is on AutoDiffXd, and numba compiles it where compiled code calls it.
"""

import math
from typing import Any

from numba.extending import overload, register_jitable
import pydrake.math

compilable = register_jitable
"""Marks a function of scalars and tuples that compiled code may call."""


def Sqrt(x: Any) -> Any:
    """Returns the square root."""
    return math.sqrt(x) if isinstance(x, float) else pydrake.math.sqrt(x)


def Sin(x: Any) -> Any:
    """Returns the sine of an angle in rad."""
    return math.sin(x) if isinstance(x, float) else pydrake.math.sin(x)


def Cos(x: Any) -> Any:
    """Returns the cosine of an angle in rad."""
    return math.cos(x) if isinstance(x, float) else pydrake.math.cos(x)


def Tanh(x: Any) -> Any:
    """Returns the hyperbolic tangent."""
    return math.tanh(x) if isinstance(x, float) else pydrake.math.tanh(x)


# Numba compares the names of the arguments: no annotations here.
overload(Sqrt)(lambda x: lambda x: math.sqrt(x))
overload(Sin)(lambda x: lambda x: math.sin(x))
overload(Cos)(lambda x: lambda x: math.cos(x))
overload(Tanh)(lambda x: lambda x: math.tanh(x))
