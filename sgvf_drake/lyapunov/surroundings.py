"""What is at the zeros of a field: density, path, curvature, and the other fields."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.path_shape import PathShape
from sgvf_drake.lyapunov.singularities import Box, FieldZeros
from sgvf_drake.paths import Reference

# On the path, or near it: within this many noise levels.
NEAR_PATH = 3.0
# Cells along each axis of the grid over the box that stands for its area.
GRID_SIZE = 201


@dataclass(frozen=True, eq=False)
class BoxSamples:
    """A field at the middles of equal cells of its box, n of them.

    Attributes:
        score: (n,) |S| sigma.
        log_density: (n,) log p of the mixture.
        on_path: (n,) whether the path is within `NEAR_PATH` noise levels.
    """

    score: FloatArray
    log_density: FloatArray
    on_path: BoolArray

    @classmethod
    def of(cls, field: GuidingField, box: Box, reference: Reference) -> "BoxSamples":
        """Samples a field."""
        lower, upper = box
        steps = (np.arange(GRID_SIZE) + 0.5) / GRID_SIZE
        unit = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        x = lower + unit * (upper - lower)
        mixture = field.mixture
        near = reference.project(x).distance <= NEAR_PATH * mixture.sigma
        score = np.linalg.norm(field.score(x), axis=1) * mixture.sigma
        return cls(score, mixture.log_density(x), near)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is at each of k zeros.

    Attributes:
        indices: (k,) their Poincare indices.
        isolated: (k,) whether it is one place, and does not stand for a line of zeros.
        log_density: (k,) log p of the mixture.
        density_percentile: (k,) part of the box in which the density is lower, 0 to 1.
        path_distance: (k,) to the path.
        on_path: (k,) whether that is at most `NEAR_PATH` noise levels.
        curvature: (k,) of the path nearby, per unit of length; NaN off the path, and on a side
            branch, whose curvature is not known.
        guiding_norm: (k,) |m|.
        score_norm: (k,) |S| sigma.
        other_distance: (k,) to the nearest zero of another field; infinite where it has none.
    """

    indices: IntArray
    isolated: BoolArray
    log_density: FloatArray
    density_percentile: FloatArray
    path_distance: FloatArray
    on_path: BoolArray
    curvature: FloatArray
    guiding_norm: FloatArray
    score_norm: FloatArray
    other_distance: FloatArray

    @classmethod
    def of(
        cls,
        zeros: FieldZeros,
        other: FieldZeros,
        field: GuidingField,
        samples: BoxSamples,
        reference: Reference,
        shape: PathShape,
    ) -> "Surroundings":
        """Looks around the zeros of m or of the score of a field.

        Args:
            zeros: The zeros.
            other: Those of another field, the nearest of which are wanted.
            field: The guiding field.
            samples: Its samples over the box.
            reference: The path.
            shape: The shape of the path.
        """
        x, mixture = zeros.points, field.mixture
        log_density = mixture.log_density(x)
        lower = np.searchsorted(np.sort(samples.log_density), log_density)
        distance = reference.project(x).distance
        near = NEAR_PATH * mixture.sigma
        to_sample, sample = nearest(shape.points, x)
        return cls(
            indices=np.array([zero.index for zero in zeros.zeros], np.intp),
            isolated=np.array([zero.kind != "degenerate" for zero in zeros.zeros], bool),
            log_density=log_density,
            density_percentile=lower / len(samples.log_density),
            path_distance=distance,
            on_path=distance <= near,
            curvature=np.where(to_sample <= near, shape.curvature[sample], np.nan),
            guiding_norm=np.linalg.norm(field(x), axis=1),
            score_norm=np.linalg.norm(field.score(x), axis=1) * mixture.sigma,
            other_distance=nearest(other.points, x)[0],
        )

    def at(self, number: int) -> dict[str, Any]:
        """Returns what is around one of the zeros, by name."""
        of_zero = ("indices", "isolated")
        names = (column.name for column in fields(self) if column.name not in of_zero)
        return {name: getattr(self, name)[number] for name in names}


def nearest(points: FloatArray, x: FloatArray) -> tuple[FloatArray, IntArray]:
    """Returns the distance from x (n, 2) to the nearest of points (k, 2), and its number.

    Infinite, and k, where there are no points.
    """
    distance, number = cKDTree(points).query(x)
    return np.asarray(distance), np.asarray(number)
