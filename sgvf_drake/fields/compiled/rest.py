"""How a field comes to rest at the ends of open paths, at one point."""

import math

import numpy as np

from sgvf_drake.compiling import part
from sgvf_drake.fields.base import FloatArray


@part
def blended_jet(
    m: FloatArray, resting: FloatArray, ends: FloatArray, width: float, z: FloatArray
) -> FloatArray:
    """Returns the jet of m + w (resting - m), with w near 1 at the ends and 0 far away.

    Args:
        m: The jet of the field away from the ends, (1 + d, d).
        resting: The same at the ends.
        ends: (E, d).
        width: Standard deviation of the region of rest.
        z: The point, (d,).
    """
    d = len(z)
    away = _away_jet(ends, width, z)
    blended = np.empty((1 + d, d))
    for j in range(1 + d):
        for i in range(d):
            blended[j, i] = m[j, i] + (1.0 - away[0]) * (resting[j, i] - m[j, i])
            if j > 0:
                blended[j, i] -= away[j] * (resting[0, i] - m[0, i])
    return blended


@part
def _away_jet(ends: FloatArray, width: float, z: FloatArray) -> FloatArray:
    """The jet of 1 - w = prod (1 - bump), (1 + d,), with a Gaussian bump around each end."""
    d = len(z)
    variance = width * width
    jet = np.zeros(1 + d)
    jet[0] = 1.0
    for e in range(len(ends)):
        square = 0.0
        for j in range(d):
            square += (z[j] - ends[e, j]) ** 2
        bump = math.exp(-0.5 * square / variance)
        for j in range(d):
            slope = -bump * (z[j] - ends[e, j]) / variance
            jet[1 + j] = jet[1 + j] * (1.0 - bump) - jet[0] * slope
        jet[0] *= 1.0 - bump
    return jet
