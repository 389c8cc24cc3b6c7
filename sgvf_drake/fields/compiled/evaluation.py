"""A guiding field's value and derivatives at one point: parts of kernels, and two kernels.

Score and tangent are put together with their derivatives, which go forward: each of them is
that of a sum or a product in the formula before it.  They are those along k directions: the
identity gives the Jacobian, one velocity the rate J v.
"""

import math
from typing import Any

import numpy as np

from sgvf_drake import compiling
from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import digest, kernel, part
from sgvf_drake.fields import activation, composition
from sgvf_drake.fields.compiled import networks, packing, strands
from sgvf_drake.fields.compiled.networks import network_jet, score_jet
from sgvf_drake.fields.compiled.packing import (
    GAIN,
    KIND,
    PAPER,
    PROJECTION_FACTOR,
    PROJECTS,
    ROBUST,
    SOFTENING,
    TANGENT_SHARE,
)
from sgvf_drake.fields.compiled.strands import learned_strands_jet, strands_jet
from sgvf_drake.fields.composition import PROJECTION_POWER


def _make_evaluate(sources: int) -> Any:
    @kernel
    def evaluate(x: FloatArray, directions: FloatArray, *field: Any) -> FloatArray:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        m = field_jet(x, directions, *field)
        d, k = m.shape[1], len(directions)
        flat = np.empty(d + d * k)
        for i in range(d):
            flat[i] = m[0, i]
            for j in range(k):
                flat[d + k * i + j] = m[1 + j, i]
        return flat

    return evaluate


def _make_evaluate_motion(sources: int) -> Any:
    @kernel
    def evaluate_motion(y: FloatArray, length: float, *motion: Any) -> FloatArray:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        m, v = motion_jet(y, np.eye(len(y)), *motion)
        return _flattened_motion(m, v, y, length)

    return evaluate_motion


@part
def field_jet(
    x: FloatArray,
    directions: FloatArray,
    center: FloatArray,
    unit_length: float,
    score_sizes: np.ndarray,
    score_numbers: FloatArray,
    tangent_sizes: np.ndarray,
    tangent_numbers: FloatArray,
    compositions: FloatArray,
    ends: FloatArray,
    rest_width: float,
) -> FloatArray:
    """Returns the jet of m, (1 + k, d), in the unit of the waypoints.

    It is that at x (d,), along directions (k, d); the other arguments are those of `packing`.
    """
    z = np.empty(len(center))
    for i in range(len(z)):
        z[i] = (x[i] - center[i]) / unit_length
    # Without sizes it is a mixture.
    if len(score_sizes) == 0:
        S = score_jet(score_numbers[1:], score_numbers[0], z, directions)
    else:
        S = network_jet(score_sizes, score_numbers, z, directions)
    N = network_jet(tangent_sizes, tangent_numbers, z, directions)
    m = composed_jet(compositions[0], S, N)
    if len(ends) > 0:
        resting = composed_jet(compositions[1], S, N)
        m = blended_jet(m, resting, ends, rest_width, z, directions)
    for k in range(1, len(m)):
        for i in range(len(z)):
            m[k, i] /= unit_length
    return m


@part
def motion_jet(
    y: FloatArray,
    directions: FloatArray,
    center: FloatArray,
    unit_length: float,
    sizes: np.ndarray,
    numbers: FloatArray,
    sigma: float,
    compositions: FloatArray,
    ends: FloatArray,
    rest_width: float,
) -> tuple[FloatArray, FloatArray]:
    """Returns the jets of m(x, h) and of the tangent of the strand, (1 + k, d) each.

    They are those at y = (x, h) (2d,), along directions (k, 2d); the other arguments are those
    of `packing`.
    """
    d = len(center)
    z, along = y.copy(), directions.copy()
    for i in range(d):
        z[i] = (y[i] - center[i]) / unit_length
        for k in range(len(along)):
            along[k, i] = directions[k, i] / unit_length
    # Without sizes it is a mixture.
    if len(sizes) == 0:
        S, N = strands_jet(numbers, sigma, z, along)
    else:
        S, N = learned_strands_jet(sizes, numbers, sigma, z, along)
    m = composed_jet(compositions[0], S, N)
    if len(ends) > 0:
        resting = composed_jet(compositions[1], S, N)
        m = blended_jet(m, resting, ends, rest_width, z[:d], along)
    return m, _direction_jet(N, compositions[0, SOFTENING])


@part
def _flattened_motion(m: FloatArray, v: FloatArray, y: FloatArray, length: float) -> FloatArray:
    """F = (m, (v - h) / length) and then its Jacobian by rows."""
    d = m.shape[1]
    flat = np.empty(2 * d + 4 * d * d)
    for i in range(d):
        flat[i] = m[0, i]
        flat[d + i] = (v[0, i] - y[d + i]) / length
        for j in range(2 * d):
            by_m = 2 * d + 2 * d * i + j
            flat[by_m] = m[1 + j, i]
            by_h = 2 * d + 2 * d * (d + i) + j
            flat[by_h] = (v[1 + j, i] - (1.0 if j == d + i else 0.0)) / length
    return flat


@part
def composed_jet(settings: FloatArray, S: FloatArray, N: FloatArray) -> FloatArray:
    """Returns the jet of m, of those of the raw score and of the tangent network.

    Args:
        settings: Those of the composition, as floats.
        S: (1 + k, d), with the derivatives along k directions.
        N: (1 + k, d).
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
    m = np.empty(S.shape)
    for j in range(len(S)):
        growth = _dot(S, 0, S, j) * da if j > 0 else 0.0
        for i in range(d):
            m[j, i] = a * S[j, i] + growth * S[0, i] + N[j, i]
    return m


@part
def _direction_jet(n: FloatArray, softening: float) -> FloatArray:
    """M = n / sqrt(|n|^2 + delta^2)."""
    d = n.shape[1]
    norm = math.sqrt(_dot(n, 0, n, 0) + softening * softening)
    m = np.empty(n.shape)
    for j in range(len(n)):
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
    m = np.empty(normal.shape)
    for j in range(len(normal)):
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
    normal = np.empty(S.shape)
    for i in range(d):
        normal[0, i] = S[0, i] - removed * v[0, i]
    for j in range(1, len(S)):
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


@part
def blended_jet(
    m: FloatArray,
    resting: FloatArray,
    ends: FloatArray,
    width: float,
    z: FloatArray,
    directions: FloatArray,
) -> FloatArray:
    """Returns the jet of m + w (resting - m), with w near 1 at the ends and 0 far away.

    Args:
        m: The jet of the field away from the ends, (1 + k, d).
        resting: The same at the ends.
        ends: (E, d).
        width: Standard deviation of the region of rest.
        z: The point, (d,).
        directions: (k, d), or more columns that do not move the point.
    """
    d = len(z)
    away = _away_jet(ends, width, z, directions)
    blended = np.empty(m.shape)
    for j in range(len(m)):
        for i in range(d):
            blended[j, i] = m[j, i] + (1.0 - away[0]) * (resting[j, i] - m[j, i])
            if j > 0:
                blended[j, i] -= away[j] * (resting[0, i] - m[0, i])
    return blended


@part
def _away_jet(
    ends: FloatArray, width: float, z: FloatArray, directions: FloatArray
) -> FloatArray:
    """The jet of 1 - w = prod (1 - bump), (1 + k,), with a Gaussian bump around each end."""
    d = len(z)
    variance = width * width
    jet = np.zeros(1 + len(directions))
    jet[0] = 1.0
    for e in range(len(ends)):
        square = 0.0
        for j in range(d):
            square += (z[j] - ends[e, j]) ** 2
        bump = math.exp(-0.5 * square / variance)
        for k in range(len(directions)):
            along = 0.0
            for j in range(d):
                along += (z[j] - ends[e, j]) * directions[k, j]
            slope = -bump * along / variance
            jet[1 + k] = jet[1 + k] * (1.0 - bump) - jet[0] * slope
        jet[0] *= 1.0 - bump
    return jet


SOURCES = (activation, compiling, composition, networks, packing, strands)
"""Every other module whose functions or constants are compiled into these."""

evaluate = _make_evaluate(digest(*SOURCES))
"""Returns m and its derivatives along k directions by rows, flattened to (d + d k,)."""

evaluate_motion = _make_evaluate_motion(digest(*SOURCES))
"""Returns F of `MemoryField` and its Jacobian by rows, flattened to (2d + 4d^2,)."""
