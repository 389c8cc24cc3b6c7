"""Where the checks look: a grid over the box, and random points, more of them near the path."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField

# Points along each axis of the grid; odd, so that the centre of the box is one of them.
GRID_SIZE = 301
# Random points in the box, and around the waypoints with this many noise levels of spread.
# The tube about the path is a few cells of the grid wide, so it needs points of its own.
BOX_SAMPLES = 20_000
NEAR_SAMPLES = 30_000
NEAR_SPREAD = 2.0


Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Samples:
    """A field, evaluated where it is to be checked.

    Attributes:
        axes: The coordinates of the grid along x and y, (k,) each, in the field's unit.
        x: The points, (n, 2): first the k^2 of the grid, y by y, then the random ones.
        s: The part of the score in m, (n, 2).
        v: The rest of m, (n, 2).
    """

    axes: tuple[FloatArray, FloatArray]
    x: FloatArray
    s: FloatArray
    v: FloatArray

    @property
    def m(self) -> FloatArray:
        """The guiding field m = s + v, (n, 2)."""
        return self.s + self.v

    @property
    def on_grid(self) -> slice:
        """The samples of the grid."""
        return slice(0, len(self.axes[0]) * len(self.axes[1]))

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner of the box."""
        lower, upper = (np.array([axis[end] for axis in self.axes]) for end in (0, -1))
        return lower, upper

    def as_grid(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Returns the values at the samples (n, ...) as those of the grid, (ky, kx, ...)."""
        shape = (len(self.axes[1]), len(self.axes[0]))
        return values[self.on_grid].reshape(*shape, *values.shape[1:])


def take_samples(field: GuidingField, seed: int = 0, grid_size: int = GRID_SIZE) -> Samples:
    """Evaluates a planar field on a grid over its box, and at random points.

    Args:
        field: The field.
        seed: Of the random points.
        grid_size: Points along each axis of the grid.

    Raises:
        ConfigurationError: The field is not planar, or the grid has fewer than 3 points.
    """
    if field.dim != 2:
        raise ConfigurationError(
            f"only planar fields are checked, not one of {field.dim}-D: what sublevel sets "
            "enclose is counted in the plane; certify and singularities take it"
        )
    if grid_size < 3:
        raise ConfigurationError(f"the grid must have at least 3 points, not {grid_size}")
    lower, upper = field.cloud.box
    x_axis, y_axis, grid = plane_grid(field.cloud.box, grid_size)
    rng = np.random.default_rng(seed)
    in_box = rng.uniform(lower, upper, (BOX_SAMPLES, 2))
    mixture = field.mixture
    centers = mixture.points[rng.integers(len(mixture.points), size=NEAR_SAMPLES)]
    near = centers + NEAR_SPREAD * mixture.sigma * rng.standard_normal(centers.shape)
    near = near[((lower <= near) & (near <= upper)).all(axis=1)]
    x = np.concatenate([grid, in_box, near])
    s, v = field.components(x)
    return Samples((x_axis, y_axis), x, s, v)
