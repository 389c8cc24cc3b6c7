"""What a guiding field is, to the systems and the experiments: a small protocol."""

from typing import Protocol, runtime_checkable

from sgvf_drake.arrays import FloatArray as FloatArray
from sgvf_drake.paths import PathNetwork


@runtime_checkable
class Field(Protocol):
    """A guiding vector field m: R^d -> R^d in the user's unit of length.

    Its value is a direction of travel: |m| is about 1 on the path, whatever the unit,
    so speed times m is a velocity.  Every method takes one point (d,) or a batch (n, d).
    """

    @property
    def dim(self) -> int:
        """The dimension d of the space."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns m(x): (d,) -> (d,), or (n, d) -> (n, d)."""

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns m(x), and J[..., i, j] = dm_i/dx_j of shape (d, d) or (n, d, d)."""

    def hessian(self, x: FloatArray) -> FloatArray:
        """Returns H[..., i, j, k] = d^2 m_i / dx_j dx_k, shape (d, d, d) or (n, d, d, d).

        Only needed where a derivative of the acceleration feed-forward J_m v is taken,
        that is, under AutoDiffXd.
        """


@runtime_checkable
class AdjustableField(Field, Protocol):
    """A field whose turn toward the path can be made wider."""

    @property
    def approach_length(self) -> float:
        """The distance from the path over which m turns from approaching to following."""

    def with_approach_length(self, length: float) -> Field:
        """Returns the same field with another approach length."""


@runtime_checkable
class MotionField(Field, Protocol):
    """The motion F(x, h) of robots that remember their heading h; of dimension 2d.

    Its first d values are m(x, h), of no unit; the others turn the heading, per unit of
    length.
    """

    @property
    def memory_length(self) -> float:
        """The distance over which a heading turns."""


@runtime_checkable
class SteerableField(Protocol):
    """A field m(x, g) that takes an intended direction."""

    @property
    def dim(self) -> int:
        """The dimension d of the space."""

    def with_memory(self) -> MotionField:
        """Returns the motion of robots whose intended direction is their own heading."""


class NetworkField(SteerableField, Protocol):
    """A field m(x, g) that follows a network of paths."""

    @property
    def network(self) -> PathNetwork:
        """The network, in the field's unit of length."""

    @property
    def memory_length(self) -> float:
        """The scale of the field: over this distance a heading turns."""


class PointField(Protocol):
    """What evaluates a field at one point at the least cost."""

    def evaluate(self, point: FloatArray) -> FloatArray:
        """Returns m and then J by rows, flattened: (d,) -> (d + d^2,)."""


@runtime_checkable
class CompilableField(Field, Protocol):
    """A field that has a compiled form for single points."""

    def compiled(self) -> PointField:
        """Returns the field's compiled form."""
