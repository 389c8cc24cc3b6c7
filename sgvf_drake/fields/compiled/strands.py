"""Score and tangent of directed strands at one place and heading, y = (z, g): their jets.

A jet is an array (1 + k, d) whose row 0 holds values, and whose row 1 + j their derivatives
along the direction j of k, rows of an array (k, 2d).
"""

import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import part
from sgvf_drake.fields.compiled.networks import network_jet
from sgvf_drake.fields.compiled.packing import TWO_WAY


@part
def strands_jet(
    numbers: FloatArray, sigma: float, y: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the jets of S and N of a `StrandMixture`.

    Every derivative is a covariance with the slopes of the components: z_i / sigma^2 by the
    position, kappa share_i T_i by the heading.

    Args:
        numbers: For each component its place, its direction, kappa, and whether it is
            travelled either way, flattened to (M (2d + 2),).
        sigma: The noise level.
        y: (2d,).
        directions: (k, 2d).
    """
    d = len(y) // 2
    stride = 2 * d + 2
    count = len(numbers) // stride
    weights, shares = np.empty(count), np.empty(count)
    top, total = -np.inf, 0.0
    for n in range(count):
        row = numbers[n * stride : (n + 1) * stride]
        square, along = 0.0, 0.0
        for i in range(d):
            square += (y[i] - row[i]) ** 2
            along += row[d + i] * y[d + i]
        along *= row[2 * d]
        exponent, shares[n] = along, 1.0
        if row[2 * d + 1] == TWO_WAY:
            exponent = abs(along) + math.log1p(math.exp(-2.0 * abs(along))) - math.log(2.0)
            shares[n] = math.tanh(along)
        weights[n] = exponent - 0.5 * square / (sigma * sigma)
        top = max(top, weights[n])
    for n in range(count):
        weights[n] = math.exp(weights[n] - top)
        total += weights[n]

    place, pull, slope = np.zeros(d), np.zeros(d), np.zeros(2 * d)
    for n in range(count):
        weights[n] /= total
        row = numbers[n * stride : (n + 1) * stride]
        for i in range(d):
            place[i] += weights[n] * row[i]
            pull[i] += weights[n] * shares[n] * row[d + i]
            slope[d + i] += weights[n] * row[2 * d] * shares[n] * row[d + i]
    variance = sigma * sigma
    rows = 1 + len(directions)
    S, N = np.zeros((rows, d)), np.zeros((rows, d))
    for i in range(d):
        S[0, i] = (place[i] - y[i]) / variance
        N[0, i] = pull[i]
        for k in range(1, rows):
            S[k, i] = -directions[k - 1, i] / variance
        slope[i] = place[i] / variance
    for n in range(count):
        # Far components add nothing, and are most of them.
        if weights[n] < 1e-18:
            continue
        row = numbers[n * stride : (n + 1) * stride]
        bend = 0.0
        if row[2 * d + 1] == TWO_WAY:
            bend = row[2 * d] * (1.0 - shares[n] * shares[n])
        for k in range(1, rows):
            rise, turn = 0.0, 0.0
            for j in range(2 * d):
                own = row[j] / variance if j < d else row[2 * d] * shares[n] * row[j]
                rise += (own - slope[j]) * directions[k - 1, j]
                if j >= d:
                    turn += row[j] * directions[k - 1, j]
            change = weights[n] * rise
            for i in range(d):
                S[k, i] += row[i] * change / variance
                N[k, i] += shares[n] * row[d + i] * change
                N[k, i] += weights[n] * bend * row[d + i] * turn
    return S, N


@part
def learned_strands_jet(
    sizes: np.ndarray, numbers: FloatArray, sigma: float, y: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the jets of S and N of a `StrandNetwork`.

    Args:
        sizes: Whether all strands are travelled either way, then those of `network_jet`.
        numbers: As those of `network_jet`.
        sigma: The noise level.
        y: (2d,).
        directions: (k, 2d).
    """
    d = len(y) // 2
    rows = 1 + len(directions)
    jet = network_jet(sizes[1:], numbers, y, directions)
    S, N = np.empty((rows, d)), np.empty((rows, d))
    if sizes[0] != TWO_WAY:
        for k in range(rows):
            for i in range(d):
                S[k, i], N[k, i] = jet[k, i] / sigma, jet[k, d + i]
        return S, N
    mirrored, mirrored_directions = y.copy(), directions.copy()
    for i in range(d):
        mirrored[d + i] = -y[d + i]
        for k in range(len(directions)):
            mirrored_directions[k, d + i] = -directions[k, d + i]
    other = network_jet(sizes[1:], numbers, mirrored, mirrored_directions)
    for k in range(rows):
        for i in range(d):
            S[k, i] = 0.5 * (jet[k, i] + other[k, i]) / sigma
            N[k, i] = 0.5 * (jet[k, d + i] - other[k, d + i])
    return S, N
