"""`DirectedField`: a guiding field m(x, g) that knows where the robot is heading."""

from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.analytic import COMPLEX_STEP, AnalyticField
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composed import ScoreInducedField
from sgvf_drake.fields.strands import StrandMixture, StrandNetwork

if TYPE_CHECKING:
    from sgvf_drake.fields.compiled import CompiledMotion

NEEDS_HEADING = (
    "the field follows a network of paths either way; it takes the intended direction too: "
    "field(x, g)"
)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class DirectedField(ScoreInducedField):
    """A guiding field m(x, g) of paths that cross, branch, or are travelled either way.

    The intended direction g is a vector of length at most 1, without a unit: it chooses among
    the strands at x, and on a strand that is travelled either way its sign.  Who gives it is
    another matter: the robot's own heading (`MemoryField`), a route, an operator.  For a
    constant g, m is a field of the position alone (`heading`).

    Calls take one point (d,) or a batch (n, d), and directions of either shape.

    Attributes:
        strands: The score and the tangent of (x, g), a network or the exact mixture.
    """

    strands: StrandMixture | StrandNetwork

    @property
    def is_one_way(self) -> bool:
        """Whether each strand has one direction of travel, so that g = 0 means something."""
        network = self.network
        return all(network.is_one_way(piece) for piece in range(network.num_pieces))

    @property
    def memory_length(self) -> float:
        """The distance over which a heading turns: a noise level, in the user's unit."""
        return self.sigma * self.cloud.unit_length

    def __call__(self, x: FloatArray, g: FloatArray | None = None) -> FloatArray:
        """Returns m(x, g), of x's shape; without g, m(x, 0).

        Raises:
            ConfigurationError: g is missing, and paths are travelled either way.
            ValueError: x or g is not of shape (d,) or (n, d).
        """
        z, g, shape = self._inputs(x, g)
        return self._value(z, g).reshape(shape)

    def value_and_jacobian(
        self, x: FloatArray, g: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Returns m, and dm_i/dx_j of shape (d, d) or (n, d, d), at a constant g."""
        z, g, shape = self._inputs(x, g)
        m, J = self._value_and_jacobian(z, g)
        by_x = J[:, :, : self.dim] / self.cloud.unit_length
        return m.reshape(shape), by_x.reshape(*shape, self.dim)

    def hessian(self, x: FloatArray, g: FloatArray | None = None) -> FloatArray:
        """Returns d^2 m_i / dx_j dx_k, (d, d, d) or (n, d, d, d), at a constant g."""
        _, g, shape = self._inputs(x, g)
        return self.heading(g).hessian(x).reshape(*shape, self.dim, self.dim)

    def jacobian_by_direction(self, x: FloatArray, g: FloatArray) -> FloatArray:
        """Returns dm_i/dg_j, of shape (d, d) or (n, d, d)."""
        z, g, shape = self._inputs(x, g)
        _, J = self._value_and_jacobian(z, g)
        return J[:, :, self.dim :].reshape(*shape, self.dim)

    def tangent(self, x: FloatArray, g: FloatArray | None = None) -> FloatArray:
        """Returns the direction of the strand that g chooses, of x's shape; length about 1."""
        z, g, shape = self._inputs(x, g)
        return self.composition.tangent(self.strands(z, g)[1]).reshape(shape)

    def heading(self, g: FloatArray) -> "HeldField":
        """Returns the field of the position alone for one intended direction, (d,) or (n, d).

        A direction for each of n points holds for batches of n only.
        """
        return HeldField(self, np.asarray(g, np.float64))

    def with_memory(self) -> "MemoryField":
        """Returns the motion of robots that go on as they are heading."""
        return MemoryField(self)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the field as one safetensors file; see `storage.save_field`."""
        # Imported here, since files know of this class.
        from sgvf_drake.fields.storage import save_field

        save_field(self, path, overwrite=overwrite)

    def _inputs(
        self, x: FloatArray, g: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, tuple[int, ...]]:
        """Normalised points and directions of the same shape (n, d), and the shape of x."""
        z, shape = self._normalized(x)
        if g is None:
            if not self.is_one_way:
                raise ConfigurationError(NEEDS_HEADING)
            return z, np.zeros_like(z), shape
        g = np.asarray(g, np.float64)
        if g.shape != (self.dim,) and g.shape != shape:
            raise ValueError(f"expected directions of shape {shape}, not {g.shape}")
        return z, np.broadcast_to(g, z.shape), shape

    def _value(self, z: FloatArray, g: FloatArray) -> FloatArray:
        s, v = self._composed(z, *self.strands(z, g))
        return s + v

    def _value_and_jacobian(
        self, z: FloatArray, g: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns m (n, d) and its derivatives by the normalised point and g, (n, d, 2d)."""
        return self._composed_and_jacobian(z, *self.strands.with_derivatives(z, g))


def check_position_alone(field: object) -> None:
    """Refuses a directed field where only those of the position alone are known.

    Raises:
        ConfigurationError: The field is a directed one.
    """
    if isinstance(field, DirectedField):
        raise ConfigurationError(
            f"this is a directed field m(x, g) of a {field.network.describe(0)}; only fields "
            "of the position alone can be examined so far"
        )


class HeldField(AnalyticField):
    """A directed field at constant intended directions: a field of the position alone.

    It has the values and the derivatives of one, and can be drawn and followed as one.
    """

    def __init__(self, field: DirectedField, g: FloatArray) -> None:
        """Holds g, (d,) or (n, d)."""
        self.field, self.g, self.cloud = field, g, field.cloud

    def _value(self, z: FloatArray) -> FloatArray:
        return self.field._value(z, self._directions(z))

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        m, J = self.field._value_and_jacobian(z, self._directions(z))
        return m, J[:, :, : self.dim]

    def _directions(self, z: FloatArray) -> FloatArray:
        return np.broadcast_to(self.g, z.shape)


class MemoryField:
    """The motion of robots that remember their heading: a field of (x, h).

    With speed times this as d(x, h)/dt, a robot moves along m(x, h), and its heading h turns to
    the tangent of its strand over the distance `DirectedField.memory_length` l:

        F(x, h) = (m(x, h), (vhat(x, h) - h) / l).

    It goes straight over crossings.  It is a field of dimension 2d as any other: for single
    points or batches, with derivatives.

    Attributes:
        field: The directed field.
    """

    def __init__(self, field: DirectedField) -> None:
        """Makes the motion of a field."""
        self.field = field

    @property
    def dim(self) -> int:
        """2d, the dimension of position and heading together."""
        return 2 * self.field.dim

    @property
    def cloud(self) -> PointCloud:
        """The waypoints."""
        return self.field.cloud

    @property
    def memory_length(self) -> float:
        """The distance over which a heading turns, in the user's unit."""
        return self.field.memory_length

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns F at x = (place, heading): (2d,) -> (2d,), or (n, 2d) -> (n, 2d)."""
        z, g, shape = self._inputs(x)
        S, N = self.field.strands(z, g)
        s, v = self.field._composed(z, S, N)
        turn = (self.field.composition.tangent(N) - g) / self.memory_length
        return np.concatenate([s + v, turn], axis=1).reshape(*shape[:-1], self.dim)

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns F, and dF_i/dx_j of shape (2d, 2d) or (n, 2d, 2d)."""
        z, g, shape = self._inputs(x)
        F, J = self._jet(z, g)
        leading = (*shape[:-1], self.dim)
        return F.reshape(leading), J.reshape(*leading, self.dim)

    def hessian(self, x: FloatArray) -> FloatArray:
        """Returns d^2 F_i / dx_j dx_k, by a complex step; see `AnalyticField.hessian`."""
        z, g, shape = self._inputs(x)
        d, unit = self.field.dim, self.field.cloud.unit_length
        steps = COMPLEX_STEP * 1j * np.eye(self.dim)
        columns = [self._jet(z + step[:d], g + step[d:])[1].imag for step in steps]
        H = np.stack(columns, axis=-1) / COMPLEX_STEP
        H[..., :d] /= unit
        return H.reshape(*shape[:-1], *(self.dim,) * 3)

    def compiled(self) -> "CompiledMotion":
        """Returns what evaluates it, compiled by numba, for one robot at a time."""
        # Imported here: it is about this class.
        from sgvf_drake.fields.compiled import CompiledMotion

        return CompiledMotion(self)

    def _inputs(self, x: FloatArray) -> tuple[FloatArray, FloatArray, tuple[int, ...]]:
        place, heading = np.split(np.asarray(x, np.float64), 2, axis=-1)
        return self.field._inputs(place, heading)

    def _jet(self, z: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F and its Jacobian by (x, h), at normalised points."""
        S, dS, N, dN = self.field.strands.with_derivatives(z, g)
        m, dm = self.field._composed_and_jacobian(z, S, dS, N, dN)
        v, by_network = self.field.composition.tangent_and_partial(N)
        dv = by_network @ dN
        d, length = self.field.dim, self.memory_length
        dv[:, :, d:] -= np.eye(d)
        F = np.concatenate([m, (v - g) / length], axis=1)
        J = np.concatenate([dm, dv / length], axis=1)
        J[:, :, :d] /= self.field.cloud.unit_length
        return F, J
