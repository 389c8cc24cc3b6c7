"""Thin rings around closed orbits, between two polygons."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes

# Beyond the rounding of corners and middles, relative to the normalised unit, by far.
ROUNDING = 1e-12
# Angles between neighbours are at least this, and the sum of all is a turn within it.
SMALLEST_ANGLE, TURN_TOLERANCE = 1e-9, 1e-6


@dataclass(frozen=True)
class Annulus:
    """What is between two polygons whose corners lie on common rays from a centre.

    Attributes:
        center: (2,) c, in normalised units, as all lengths here.
        vertices: (K, 2) a polygon in the middle, counter-clockwise around c.
        widths: (K,) how far the two polygons are from each vertex along its ray.
    """

    center: tuple[float, float]
    vertices: tuple[tuple[float, float], ...]
    widths: tuple[float, ...]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Annulus":
        """Returns the ring of a JSON object.

        Raises:
            TypeError: The object is not that of a ring.
            ValueError: The same.
        """
        points = [(float(x), float(y)) for x, y in (body["center"], *body["vertices"])]
        return cls(points[0], tuple(points[1:]), tuple(map(float, body["widths"])))

    @property
    def borders(self) -> tuple[FloatArray, FloatArray]:
        """The corners (K, 2) of the inner polygon and of the outer one."""
        center, rays = np.array(self.center), self._rays
        share = np.array(self.widths)[:, None] / np.linalg.norm(rays, axis=1, keepdims=True)
        return center + (1 - share) * rays, center + (1 + share) * rays

    @property
    def is_ring(self) -> bool:
        """Whether both polygons go around the centre once, one inside of the other.

        With corners on common rays that turn one way, they are star-shaped, and in each
        sector between two rays their sides do not meet.
        """
        rays, widths = self._rays, np.array(self.widths)
        radii = np.linalg.norm(rays, axis=1)
        next_rays = np.roll(rays, -1, axis=0)
        cross = rays[:, 0] * next_rays[:, 1] - rays[:, 1] * next_rays[:, 0]
        angles = np.arctan2(cross, (rays * next_rays).sum(axis=1))
        return bool(
            len(widths) == len(rays) >= 3
            and (angles > SMALLEST_ANGLE).all()
            and abs(angles.sum() - 2 * np.pi) < TURN_TOLERANCE
            and ((widths > 1e3 * ROUNDING) & (widths < radii)).all()
        )

    def squares(self, fineness: int = 1) -> Boxes:
        """Returns squares that cover the ring, about as wide as it is or a part of that.

        Args:
            fineness: So many squares from one polygon to the other.
        """
        inner, outer = self.borders
        length = np.linalg.norm(np.roll(inner, -1, axis=0) - inner, axis=1)
        along = fineness * int(np.ceil(np.median(length / (2 * np.array(self.widths)))))
        s = np.linspace(0, 1, fineness + 1)[:, None, None, None]
        t = np.linspace(0, 1, along + 1)[:, None, None]
        across = (1 - s) * inner + s * outer
        points = (1 - t) * across + t * np.roll(across, -1, axis=2)
        corners = np.stack(
            [points[i : i + fineness, j : j + along] for i in (0, 1) for j in (0, 1)]
        ).reshape(4, -1, 2)
        low, high = corners.min(axis=0), corners.max(axis=0)
        half = (high - low).max(axis=1) / 2
        return Boxes((low + high) / 2, half + ROUNDING * (1 + np.abs(high).max()))

    @property
    def _rays(self) -> FloatArray:
        return np.asarray(np.array(self.vertices).reshape(-1, 2) - self.center)
