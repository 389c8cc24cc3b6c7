"""The score of a Gaussian mixture with its derivatives at one point."""

import math

import numpy as np

from sgvf_drake.compiling import part
from sgvf_drake.fields.base import FloatArray


@part
def score_jet(points: FloatArray, variance: float, z: FloatArray) -> FloatArray:
    """Returns the jet of the score at z, (1 + d, d).

    dS/dz = cov / sigma^4 - I / sigma^2, with the covariance of the waypoints as z weighs them.

    Args:
        points: The centres, flattened to (N d,).
        variance: sigma^2, in the square of their unit.
        z: The point, (d,).
    """
    d = len(z)
    weights, mean = _weights_and_mean(points, variance, z)
    jet = np.zeros((1 + d, d))
    for n in range(len(weights)):
        for i in range(d):
            share = weights[n] * (points[n * d + i] - mean[i])
            for j in range(i + 1):
                jet[1 + j, i] += share * (points[n * d + j] - mean[j])
    for i in range(d):
        jet[0, i] = (mean[i] - z[i]) / variance
        for j in range(i + 1):
            slope = (jet[1 + j, i] / variance - (1.0 if i == j else 0.0)) / variance
            jet[1 + j, i] = jet[1 + i, j] = slope
    return jet


@part
def _weights_and_mean(
    points: FloatArray, variance: float, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the shares that the waypoints have in the density at z, and their mean."""
    d = len(z)
    weights, mean = np.empty(len(points) // d), np.zeros(d)
    top, total = -np.inf, 0.0
    for n in range(len(weights)):
        square = 0.0
        for i in range(d):
            square += (z[i] - points[n * d + i]) ** 2
        weights[n] = -0.5 / variance * square
        top = max(top, weights[n])
    for n in range(len(weights)):
        weights[n] = math.exp(weights[n] - top)
        total += weights[n]
    for n in range(len(weights)):
        weights[n] /= total
        for i in range(d):
            mean[i] += weights[n] * points[n * d + i]
    return weights, mean
