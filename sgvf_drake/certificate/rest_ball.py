"""Balls in which a vehicle comes to rest, and their proof.

Let (v . J v) <= -rate |v|^2 all over a ball about c, with a rate above zero.  Then two orbits
in it come together as exp(-rate t), and on its border m goes inward at rate * radius - |m(c)|
at least.  Where that is above zero, no orbit leaves the ball, so that it holds a zero of m
(Brouwer), which is the only one and to which all orbits from the ball lead.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
import math
from typing import Any

import numpy as np

from sgvf_drake.certificate.contraction import ROUNDING, rate_of_distances
from sgvf_drake.certificate.field_model import (
    BoundedField,
    dual_field,
    has_dual,
    largest_error,
    model_field,
)
from sgvf_drake.certificate.patches import Patches

# Cubes along each axis that cover a ball.
ALONG = 4


@dataclass(frozen=True)
class RestBall:
    """A ball, in normalised units.

    Attributes:
        center: c.
        radius: Its radius.
    """

    center: tuple[float, ...]
    radius: float

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "RestBall":
        """Returns the ball of a JSON object.

        Raises:
            KeyError: If something is missing.
            TypeError: If it is not the object of a ball.
            ValueError: If a number is not finite, or the radius not above zero.
        """
        ball = cls(tuple(map(float, body["center"])), float(body["radius"]))
        if not all(map(math.isfinite, ball.center)) or not 0 < ball.radius < math.inf:
            raise ValueError(f"{ball} is not a ball")
        return ball

    @property
    def cover(self) -> Patches:
        """Cubes that hold the ball."""
        dim, half = len(self.center), self.radius / ALONG
        steps = half * np.arange(1 - ALONG, ALONG, 2)
        offsets = np.array(list(product(steps, repeat=dim)))
        nearest = np.linalg.norm(np.maximum(np.abs(offsets) - half, 0), axis=1)
        centers = np.array(self.center) + offsets[nearest <= (1 + ROUNDING) * self.radius]
        # A part of the radius, and what rounding moves the centres by.
        half += ROUNDING * (half + np.abs(centers).max())
        return Patches(centers, np.broadcast_to(half * np.eye(dim), (len(centers), dim, dim)))


@dataclass(frozen=True)
class RestProof:
    """What is proved of a ball.

    Attributes:
        rate: That at which orbits in it come together, at least; zero: it is not proved that
            they do.
        inflow: The speed of m into the ball on its border, at least.
        patches: Over how many patches the field was bounded.
    """

    rate: float
    inflow: float
    patches: int

    @property
    def proved(self) -> bool:
        """Whether all orbits from the ball stay in it and lead to one zero of m."""
        return self.rate > 0 and self.inflow > 0


def prove_rest(field: BoundedField, ball: RestBall) -> RestProof:
    """Proves that what is in a ball comes to rest in it."""
    if not has_dual(field):
        return RestProof(0.0, 0.0, 0)
    cover = ball.cover
    with np.errstate(over="ignore", invalid="ignore"):
        rate = -float(rate_of_distances(dual_field(field, cover)).max())
        at_center = model_field(field, Patches.points(np.array([ball.center]))).magnitude
    if not rate > 0:
        return RestProof(0.0, 0.0, len(cover))
    against = np.linalg.norm(at_center) + largest_error(field, cover)
    inflow = (1 - ROUNDING) * rate * ball.radius - (1 + ROUNDING) * against
    return RestProof(rate, float(inflow), len(cover) + 1)
