"""Where the checks look: a grid over the box, and random points, more of them near the path."""

from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sgvf_drake.arrays import FloatArray, box_grid
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField

# Points along each axis of the grid, by the dimension: about as many in all.  They are odd, so
# that the centre of the box is one of them.
GRID_SIZES = {2: 301, 3: 45}
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
        axes: The coordinates of the grid along x, y and so on, (k,) each, in the field's unit.
        x: The points, (n, d): first the k^d of the grid, y by y, then the random ones.
        s: The part of the score in m, (n, d).
        v: The rest of m, (n, d).
    """

    axes: tuple[FloatArray, ...]
    x: FloatArray
    s: FloatArray
    v: FloatArray

    @property
    def m(self) -> FloatArray:
        """The guiding field m = s + v, (n, d)."""
        return self.s + self.v

    @property
    def on_grid(self) -> slice:
        """The samples of the grid."""
        return slice(0, math.prod(map(len, self.axes)))

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner of the box."""
        lower, upper = (np.array([axis[end] for axis in self.axes]) for end in (0, -1))
        return lower, upper

    def as_grid(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Returns the values at the samples (n, ...) as those of the grid, (ky, kx, ...).

        In space they are (kz, ky, kx, ...).
        """
        shape = tuple(map(len, self.axes[::-1]))
        return values[self.on_grid].reshape(*shape, *values.shape[1:])


def take_samples(field: GuidingField, seed: int = 0, grid_size: int | None = None) -> Samples:
    """Evaluates a field on a grid over its box, and at random points.

    Args:
        field: The field.
        seed: Of the random points.
        grid_size: Points along each axis of the grid; None: `GRID_SIZES`.

    Raises:
        ConfigurationError: The field is neither planar nor spatial, or the grid has fewer than
            3 points.
    """
    if field.dim not in GRID_SIZES:
        raise ConfigurationError(f"fields are checked in 2-D and 3-D, not in {field.dim}-D")
    grid_size = GRID_SIZES[field.dim] if grid_size is None else grid_size
    if grid_size < 3:
        raise ConfigurationError(f"the grid must have at least 3 points, not {grid_size}")
    lower, upper = field.cloud.box
    axes, grid = box_grid(field.cloud.box, grid_size)
    rng = np.random.default_rng(seed)
    in_box = rng.uniform(lower, upper, (BOX_SAMPLES, field.dim))
    mixture = field.mixture
    centers = mixture.points[rng.integers(len(mixture.points), size=NEAR_SAMPLES)]
    near = centers + NEAR_SPREAD * mixture.sigma * rng.standard_normal(centers.shape)
    near = near[((lower <= near) & (near <= upper)).all(axis=1)]
    x = np.concatenate([grid, in_box, near])
    s, v = field.components(x)
    return Samples(axes, x, s, v)
