"""How score and tangent are put together, with the derivatives, at one point.

The derivatives go forward: each of them is that of a sum or a product in the formula before it.
"""

import math

import numpy as np

from sgvf_drake.compiling import part
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composition import PROJECTION_POWER

PAPER, NORMALISED, ROBUST = range(3)
"""The kinds of composition."""

# Where the settings of a composition hold what; see `packing.pack_composition`.
KIND, GAIN, SOFTENING, PROJECTS, PROJECTION_FACTOR, TANGENT_SHARE = range(6)


@part
def composed_jet(settings: FloatArray, S: FloatArray, N: FloatArray) -> FloatArray:
    """Returns the jet of m, of those of the raw score and of the tangent network.

    Args:
        settings: Those of the composition, as floats.
        S: (1 + d, d).
        N: (1 + d, d).
    """
    if settings[KIND] == ROBUST:
        return _robust_jet(settings, S, _direction_jet(N, settings[SOFTENING]))
    m = _paper_jet(settings[GAIN], S, N)
    return m if settings[KIND] == PAPER else _direction_jet(m, settings[SOFTENING])


@part
def _paper_jet(gain: float, S: FloatArray, N: FloatArray) -> FloatArray:
    """M = tanh(k_s |S|) S / |S| + N."""
    d = S.shape[1]
    a, _, da, _ = _squash(gain, _dot(S, 0, S, 0))
    m = np.empty((1 + d, d))
    for j in range(1 + d):
        growth = _dot(S, 0, S, j) * da if j > 0 else 0.0
        for i in range(d):
            m[j, i] = a * S[j, i] + growth * S[0, i] + N[j, i]
    return m


@part
def _direction_jet(n: FloatArray, softening: float) -> FloatArray:
    """M = n / sqrt(|n|^2 + delta^2)."""
    d = n.shape[1]
    norm = math.sqrt(_dot(n, 0, n, 0) + softening * softening)
    m = np.empty((1 + d, d))
    for j in range(1 + d):
        along = _dot(m, 0, n, j) if j > 0 else 0.0
        for i in range(d):
            m[j, i] = n[j, i] / norm
            if j > 0:
                m[j, i] -= along * m[0, i] / norm
    return m


@part
def _robust_jet(settings: FloatArray, S: FloatArray, v: FloatArray) -> FloatArray:
    """M = tanh(k_s |S'|) S'/|S'| + sech(k_s |S'|) v, S' = S - g (S . v) v."""
    d = S.shape[1]
    normal = _normal_jet(settings, S, v)
    a, b, da, db = _squash(settings[GAIN], _dot(normal, 0, normal, 0))
    b, db = settings[TANGENT_SHARE] * b, settings[TANGENT_SHARE] * db
    m = np.empty((1 + d, d))
    for j in range(1 + d):
        growth = _dot(normal, 0, normal, j) if j > 0 else 0.0
        for i in range(d):
            slope = growth * (da * normal[0, i] + db * v[0, i])
            m[j, i] = a * normal[j, i] + b * v[j, i] + slope
    return m


@part
def _normal_jet(settings: FloatArray, S: FloatArray, v: FloatArray) -> FloatArray:
    """S' = S - g (S . v) v, with g = 1 / (1 + (factor |S|^2)^4) or zero."""
    d = S.shape[1]
    half = PROJECTION_POWER // 2
    factor, along = settings[PROJECTION_FACTOR], _dot(S, 0, v, 0)
    ratio = factor * _dot(S, 0, S, 0)
    g = settings[PROJECTS] / (1.0 + ratio**half)
    g_slope = -half * factor * ratio ** (half - 1) * g * g
    removed = g * along
    normal = np.empty((1 + d, d))
    for i in range(d):
        normal[0, i] = S[0, i] - removed * v[0, i]
    for j in range(1, 1 + d):
        change = 2.0 * g_slope * _dot(S, 0, S, j) * along
        change += g * (_dot(S, j, v, 0) + _dot(S, 0, v, j))
        for i in range(d):
            normal[j, i] = S[j, i] - change * v[0, i] - removed * v[j, i]
    return normal


@part
def _squash(gain: float, square: float) -> tuple[float, float, float, float]:
    """tanh(k r)/r and sech(k r) as functions of r^2, and (d/dr)/r of both."""
    if square < 1e-24:
        square = 1e-24
    r = math.sqrt(square)
    a, b = math.tanh(gain * r) / r, _sech(gain * r)
    z = gain * gain * square
    if z < 1e-4:
        # Where k r is small the difference cancels; its series starts at -2/3 k^3.
        da = gain**3 * (-2.0 / 3.0 + z * (8.0 / 15.0 - z * 34.0 / 105.0))
    else:
        da = (gain * b * b - a) / square
    return a, b, da, -gain * a * b


@part
def _sech(z: float) -> float:
    # By the decaying exponential, which cannot overflow far from the path.
    decay = math.exp(-z)
    return 2.0 * decay / (1.0 + decay * decay)


@part
def _dot(a: FloatArray, i: int, b: FloatArray, j: int) -> float:
    """Returns the product of row i of a and row j of b."""
    total = 0.0
    for k in range(a.shape[1]):
        total += a[i, k] * b[j, k]
    return total
