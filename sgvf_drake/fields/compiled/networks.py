"""What was learned, at one point: the jets of a perceptron and of the score of a mixture.

A jet is an array (1 + k, n) whose row 0 holds n values, and whose row 1 + j their derivatives
along the direction j of k, rows of an array (k, d).  The identity gives the Jacobian, and a
velocity alone the rate J v, at a third of the cost in the plane.
"""

import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import accumulating_part, part
from sgvf_drake.fields.activation import ACTIVATIONS, NORMAL_RANGE
from sgvf_drake.fields.compiled.packing import (
    ACTIVATION,
    FIRST_WIDTH,
    LEAST_EXPONENT,
    NUM_FREQUENCIES,
)

# The numbers by which `value_and_slope` knows the activations.
_SILU, _TANH, _SIGMOID, _SOFTPLUS, _GELU, _ELU, _RELU = range(len(ACTIVATIONS))
# Rows of W^T, those of eight inputs, that are added in one pass over the sums: these are then
# seldom loaded and stored, and the processor does little but multiply and add.
INPUTS_AT_ONCE = 8


@part
def network_jet(
    sizes: np.ndarray, numbers: FloatArray, z: FloatArray, directions: FloatArray
) -> FloatArray:
    """Returns the jet of a network's outputs at z, (1 + k, outputs).

    Args:
        sizes: Its activation, its number of frequencies, and the widths of all layers.
        numbers: Frequencies and phases, then W^T and b of each layer, flattened.
        z: The point, (d,).
        directions: (k, d).
    """
    widths = sizes[FIRST_WIDTH:]
    widest = 0
    for width in widths:
        widest = max(widest, width)
    # Whole rows and not parts of them are passed on, so that they are known to be contiguous.
    jet = np.empty((1 + len(directions), widest))
    following = np.empty((1 + len(directions), widest))
    at = _input_jet(sizes[NUM_FREQUENCIES], widths[0], numbers, z, directions, jet)
    last = len(widths) - 2
    for layer in range(last + 1):
        inputs, outputs = widths[layer], widths[layer + 1]
        end_of_weights = at + inputs * outputs
        weights = numbers[at:end_of_weights]
        at = end_of_weights + outputs
        _affine(weights, numbers[end_of_weights:at], jet, following)
        if layer < last:
            # The layer before has been used up, and lends its memory to the slopes.
            _activate(sizes[ACTIVATION], outputs, following, jet[0])
        jet, following = following, jet
    return _first_columns(widths[-1], jet)


@part
def _input_jet(
    num_frequencies: int,
    width: int,
    numbers: FloatArray,
    z: FloatArray,
    directions: FloatArray,
    jet: FloatArray,
) -> int:
    """Fills in what the first layer sees; returns how many numbers that took."""
    # The last inputs are passed on as they are: all of them where there are no frequencies.
    passed = width - 2 * num_frequencies
    d = len(z) - passed
    for i in range(passed):
        jet[0, 2 * num_frequencies + i] = z[d + i]
        for k in range(len(directions)):
            jet[1 + k, 2 * num_frequencies + i] = directions[k, d + i]
    num_slopes = num_frequencies * d
    for f in range(num_frequencies):
        frequencies = numbers[f * d : (f + 1) * d]
        angle = numbers[num_slopes + f]
        for j in range(d):
            angle += frequencies[j] * z[j]
        sine, cosine = math.sin(angle), math.cos(angle)
        jet[0, f], jet[0, num_frequencies + f] = sine, cosine
        for k in range(len(directions)):
            slope = 0.0
            for j in range(d):
                slope += frequencies[j] * directions[k, j]
            jet[1 + k, f] = cosine * slope
            jet[1 + k, num_frequencies + f] = -sine * slope
    return num_slopes + num_frequencies


@part
def _first_columns(n: int, jet: FloatArray) -> FloatArray:
    columns = np.empty((len(jet), n))
    for k in range(len(jet)):
        for o in range(n):
            columns[k, o] = jet[k, o]
    return columns


@accumulating_part
def _affine(weights: FloatArray, bias: FloatArray, jet: FloatArray, out: FloatArray) -> None:
    """Fills in the jet of W h + b, with W^T of shape (inputs, outputs) flattened."""
    n = len(bias)
    inputs = len(weights) // n
    whole = inputs - inputs % INPUTS_AT_ONCE
    for k in range(len(jet)):
        row = out[k]
        for o in range(n):
            row[o] = bias[o] if k == 0 else 0.0
    for i in range(0, whole, INPUTS_AT_ONCE):
        w, v = weights[i * n : (i + 4) * n], weights[(i + 4) * n : (i + 8) * n]
        for k in range(len(jet)):
            h, row = jet[k, i : i + INPUTS_AT_ONCE], out[k]
            h0, h1, h2, h3, h4, h5, h6, h7 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7]
            for o in range(n):
                first = w[o] * h0 + w[n + o] * h1 + w[2 * n + o] * h2 + w[3 * n + o] * h3
                second = v[o] * h4 + v[n + o] * h5 + v[2 * n + o] * h6 + v[3 * n + o] * h7
                row[o] += first + second
    for i in range(whole, inputs):
        w = weights[i * n : (i + 1) * n]
        for k in range(len(jet)):
            h0, row = jet[k, i], out[k]
            for o in range(n):
                row[o] += w[o] * h0


@part
def _activate(code: int, width: int, jet: FloatArray, slopes: FloatArray) -> None:
    """Applies an activation in place."""
    values = jet[0]
    for o in range(width):
        values[o], slopes[o] = value_and_slope(code, values[o])
    for k in range(1, len(jet)):
        row = jet[k]
        for o in range(width):
            row[o] *= slopes[o]


@part
def value_and_slope(code: int, z: float) -> tuple[float, float]:
    """Returns the activation and its derivative at z."""
    if code == _SILU:
        gate = _sigmoid(z)
        value = z * gate
        return value, gate + value * (1.0 - gate)
    if code == _TANH:
        value = math.tanh(z)
        return value, 1.0 - value * value
    if code == _SIGMOID:
        value = _sigmoid(z)
        return value, value * (1.0 - value)
    if code == _SOFTPLUS:
        return _relu(z) + math.log1p(math.exp(-abs(z))), _sigmoid(z)
    if code == _GELU:
        return _gelu_and_slope(z)
    if code == _ELU:
        value = z if z > 0.0 else math.expm1(z)
        return value, 1.0 if z > 0.0 else value + 1.0
    return _relu(z), 1.0 if z > 0.0 else 0.0


@part
def _sigmoid(z: float) -> float:
    # Far below zero the exponential is infinite, and its inverse zero, as it should be.
    return 1.0 / (1.0 + math.exp(-z))


@part
def _relu(z: float) -> float:
    # In this order a NaN stays one.
    return 0.0 if z <= 0.0 else z


@part
def _gelu_and_slope(z: float) -> tuple[float, float]:
    near = min(max(z, -NORMAL_RANGE), NORMAL_RANGE)
    share = 0.5 + 0.5 * math.erf(near / math.sqrt(2.0))
    density = math.exp(-0.5 * near * near) / math.sqrt(2.0 * math.pi)
    return z * share, share + near * density


@part
def score_jet(
    points: FloatArray, variance: float, z: FloatArray, directions: FloatArray
) -> FloatArray:
    """Returns the jet of the score at z, (1 + k, d).

    dS/dz = cov / sigma^4 - I / sigma^2, with the covariance of the waypoints as z weighs them.

    Args:
        points: The centres, one coordinate after the other: (d, N) flattened to (d N,).
        variance: sigma^2, in the square of their unit.
        z: The point, (d,).
        directions: (k, d).
    """
    d = len(z)
    weights, mean = _weights_and_mean(points, variance, z)
    covariance = np.zeros((d, d))
    size = len(weights)
    for i in range(d):
        p = points[i * size : (i + 1) * size]
        for j in range(i + 1):
            q, total = points[j * size : (j + 1) * size], 0.0
            for n in range(size):
                total += weights[n] * (p[n] - mean[i]) * (q[n] - mean[j])
            covariance[i, j] = total
    jet = np.zeros((1 + len(directions), d))
    for i in range(d):
        jet[0, i] = (mean[i] - z[i]) / variance
        for j in range(i + 1):
            slope = (covariance[i, j] / variance - (1.0 if i == j else 0.0)) / variance
            for k in range(len(directions)):
                jet[1 + k, i] += slope * directions[k, j]
                if j < i:
                    jet[1 + k, j] += slope * directions[k, i]
    return jet


@part
def _weights_and_mean(
    points: FloatArray, variance: float, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the shares that the waypoints have in the density at z, and their mean."""
    d = len(z)
    size = len(points) // d
    weights, mean = np.zeros(size), np.zeros(d)
    for i in range(d):
        p = points[i * size : (i + 1) * size]
        for n in range(size):
            weights[n] += (z[i] - p[n]) ** 2
    top, total = -np.inf, 0.0
    for n in range(size):
        weights[n] *= -0.5 / variance
        top = max(top, weights[n])
    for n in range(size):
        exponent = weights[n] - top
        # Far ones add less than rounding, and are most of them; a NaN stays one.
        weights[n] = 0.0 if exponent < LEAST_EXPONENT else math.exp(exponent)
        total += weights[n]
    for n in range(size):
        weights[n] /= total
    for i in range(d):
        p, place = points[i * size : (i + 1) * size], 0.0
        for n in range(size):
            place += weights[n] * p[n]
        mean[i] = place
    return weights, mean
