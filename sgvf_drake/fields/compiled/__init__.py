"""Guiding fields compiled by numba, for one point at a time.

A controller asks its field for one point a hundred times a second, where NumPy spends most of
its time on the calls themselves.  The modules here say once more, for one point and compiled,
what those of the same name in `sgvf_drake.fields` say for batches.  They work on jets: arrays
(1 + d, k) whose row 0 holds k values, and whose row 1 + j their derivatives by input j.

Everything that makes one field differ from another is an argument, so that one compilation
serves all fields; `packing` makes these arguments.  Importing this package alone does not
import numba.
"""

from sgvf_drake.fields.compiled.field import CompiledField

__all__ = ["CompiledField"]
