"""How a robot comes to rest at the end of an open path."""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composition import RobustComposition

# Width of the region of rest, in noise levels.  It has to reach past the distance at which
# the projection lets go of the score by itself, or robots stop short of the end from outside.
REST_WIDTH = 3.0
# A field that is widened for a vehicle turns over a longer distance than half a noise level;
# the region grows with it, by this share, so that the vehicle has room to slow down.
WIDENED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Rest:
    """Near an end, the score keeps its part along the path, and so holds the robot there.

    Past the end of the waypoints their density falls, and the score points back.  The robot
    rests where that balances the tangent, about half a noise level before the last one, and
    |m| falls to zero on the way: that is the taper of the speed.  The tangent of a widened
    field is scaled down by as much as its score is, so that it rests at the same place.

    Attributes:
        ends: (E, d) normalised units.
        width: Standard deviation of the region of rest, normalised units.
        composition: The composition at the ends, without the projection.
    """

    ends: FloatArray
    width: float
    composition: RobustComposition

    @classmethod
    def at(cls, ends: FloatArray, composition: RobustComposition) -> "Rest":
        """Returns the rest of a composition at its ends, (E, d) in normalised units."""
        sigma, approach_length = composition.sigma, composition.sigma**2 / composition.gain
        resting = replace(
            composition, projects=False, tangent_share=min(1.0, 0.5 * sigma / approach_length)
        )
        width = REST_WIDTH * max(sigma, WIDENED_SHARE * approach_length)
        return cls(ends, width, resting)

    def weight(self, z: FloatArray) -> FloatArray:
        """Returns how near z is to an end: 1 there, 0 far away; (n, d) -> (n,)."""
        return 1 - np.prod(1 - self._bumps(z)[0], axis=1)

    def weight_and_gradient(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the weight (n,) and its gradient (n, d)."""
        bumps, slopes = self._bumps(z)
        gradient = np.zeros_like(z)
        for end in range(len(self.ends)):
            others = np.prod(1 - np.delete(bumps, end, axis=1), axis=1)
            gradient += others[:, None] * slopes[:, end]
        return 1 - np.prod(1 - bumps, axis=1), gradient

    def _bumps(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A Gaussian around each end, (n, E), and its gradient, (n, E, d)."""
        offset = z[:, None, :] - self.ends
        variance = self.width**2
        bumps = np.exp(-0.5 * (offset**2).sum(axis=2) / variance)
        return bumps, -bumps[:, :, None] * offset / variance
