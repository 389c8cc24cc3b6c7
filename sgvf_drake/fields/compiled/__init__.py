"""Guiding fields compiled by numba, for one point at a time.

A controller asks its field for one point a hundred times a second, where NumPy spends most of
its time on the calls themselves.  The modules here say once more, for one point and compiled,
what those of `sgvf_drake.fields` say for batches.

Everything that makes one field differ from another is an argument, so that one compilation
serves all fields; `packing` makes these arguments.  Importing this package alone does not
import numba.
"""

from typing import Any

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.compiled.packing import pack_composed, pack_learned, pack_strands
from sgvf_drake.fields.composed import ComposedField
from sgvf_drake.fields.directed import MemoryField


class CompiledField:
    """A guiding field for those who ask for one point at a time, such as a controller.

    It is the same field, to rounding.  A point (d,) goes to code that numba compiled, value
    and Jacobian in one; batches (n, d), and the Hessian, go to the field in NumPy.  Where a
    coordinate is NaN, the value and the Jacobian are.

    All fields share one compiled function.  It is compiled at the first point that any field
    is asked for, in a few seconds, and from then on comes from numba's cache on disk.  It may
    be called from several threads at once.

    Attributes:
        field: The guiding field.
        arguments: It, as `evaluation.field_jet` takes it.
    """

    field: ComposedField
    arguments: tuple[Any, ...]

    def __init__(self, field: ComposedField, *, learned: tuple[Any, ...] | None = None) -> None:
        """Packs a field.

        Args:
            field: The guiding field.
            learned: Its networks as `packing.pack_learned` gives them, if that was done.
        """
        # Here, because numba takes long to import and not everybody needs it.
        from sgvf_drake.fields.compiled.evaluation import evaluate

        self.field = field
        self._learned = pack_learned(field) if learned is None else learned
        self.arguments = (*self._learned, *pack_composed(field))
        self._evaluate = evaluate
        self._axes = np.eye(field.dim)
        self._shape = (field.dim,)

    @property
    def cloud(self) -> PointCloud:
        """The waypoints."""
        return self.field.cloud

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return self.field.dim

    @property
    def approach_length(self) -> float:
        """As `ComposedField.approach_length`."""
        return self.field.approach_length

    def with_approach_length(self, length: float) -> "CompiledField":
        """As `ComposedField.with_approach_length`; nothing is compiled or copied for it.

        Raises:
            ConfigurationError: The length is not a positive number.
        """
        return CompiledField(self.field.with_approach_length(length), learned=self._learned)

    def evaluate(self, point: FloatArray, directions: FloatArray | None = None) -> FloatArray:
        """Returns m and then J by rows at one point, flattened: (d,) -> (d + d^2,).

        Args:
            point: An array, a tuple or a list.
            directions: Float64 (k, d); in place of J there are then its products with these,
                J v in each column of (d, k), at less cost.

        Raises:
            ValueError: The point is not of shape (d,).
        """
        # A copy is contiguous, aligned and writable, so numba sees one type of array only.
        x = np.array(point, dtype=np.float64)
        if x.shape != self._shape:
            raise ValueError(f"expected a position of shape {self._shape}, not {x.shape}")
        directions = self._axes if directions is None else directions
        return self._evaluate(x, directions, *self.arguments)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns m(x): (d,) -> (d,), or (n, d) -> (n, d)."""
        if np.shape(x) != self._shape:
            return self.field(x)
        (d,) = self._shape
        return self.evaluate(x)[:d]

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns m(x), and J[..., i, j] = dm_i/dx_j of shape (d, d) or (n, d, d)."""
        if np.shape(x) != self._shape:
            return self.field.value_and_jacobian(x)
        (d,) = self._shape
        flat = self.evaluate(x)
        return flat[:d], flat[d:].reshape(d, d)

    def hessian(self, x: FloatArray) -> FloatArray:
        """Returns H[..., i, j, k] = d^2 m_i / dx_j dx_k, shape (d, d, d) or (n, d, d, d)."""
        return self.field.hessian(x)


class CompiledMotion:
    """A `MemoryField` for those who ask for one place and heading at a time.

    It is the same field of y = (x, h), to rounding, as `CompiledField` is of x.

    Attributes:
        motion: The field.
        arguments: It, as `evaluation.motion_jet` takes it.
    """

    def __init__(self, motion: MemoryField) -> None:
        """Packs the field."""
        # Here, because numba takes long to import and not everybody needs it.
        from sgvf_drake.fields.compiled.evaluation import evaluate_motion

        self.motion = motion
        field = motion.field
        self.arguments = (
            np.array(field.cloud.center),
            field.cloud.unit_length,
            *pack_strands(field.strands),
            field.sigma,
            *pack_composed(field),
        )
        self._evaluate = evaluate_motion
        self._shape = (motion.dim,)

    def evaluate(self, y: FloatArray) -> FloatArray:
        """Returns F and then its Jacobian by rows at one place and heading: (2d + 4d^2,).

        Raises:
            ValueError: y is not of shape (2d,).
        """
        y = np.array(y, dtype=np.float64)
        if y.shape != self._shape:
            raise ValueError(f"expected (x, h) of shape {self._shape}, not {y.shape}")
        return self._evaluate(y, self.motion.memory_length, *self.arguments)
