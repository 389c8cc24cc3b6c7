"""The inner loops of Taylor models, compiled: one pass over memory where NumPy takes twenty.

The parts of a model are (n, 6, k): for each of n squares and k functions the value, the two
slopes, and the factors of d_0^2, d_0 d_1 and d_1^2.  Nothing here compares with what may not be
a number: sums and absolute values hand it on, so that it is not below any bound later.

The constants stand here, since a change of what a kernel takes from elsewhere does not reach
the cache of compiled code.
"""

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import kernel

UNIT = 2.0**-53
"""The unit roundoff of float64."""

ROUNDINGS = 32
"""More than the roundings one after another in any operation on scalars here."""

SLACK = 2 * ROUNDINGS * UNIT
"""What the roundings of an operation change its result by, at most, relative to the sum of the
magnitudes that are added in it: n of them make (1 + UNIT)^n - 1, which is below 2 n UNIT."""

TINY = 1e-290
"""Above what underflow can change a result by."""


def check_rounding() -> None:
    """Makes sure that results are rounded to nearest, as UNIT assumes.

    Libraries of interval arithmetic may leave a process with another rounding.

    Raises:
        RuntimeError: They are not.
    """
    # A quarter and three quarters of the way to the next number.
    for one in np.array([1.0, -1.0]):
        if one + one * UNIT / 2 != one or one + one * 3 * UNIT / 2 != one + one * 2 * UNIT:
            raise RuntimeError(
                "float64 is not rounded to nearest in this process: nothing is proved"
            )


LINEAR, CURVED, LOWER, UPPER, MAGNITUDE = range(5)
"""Rows of what `ranges` returns."""


@kernel
def ranges(half: FloatArray, parts: FloatArray, remainder: FloatArray) -> FloatArray:
    """Returns how far functions go over their squares, (5, n, k).

    How far their linear part and all the rest take them from their value, at most; what they
    are at least and at most; and what their absolute values and those of their parts are.
    """
    n, _, k = parts.shape
    found = np.empty((5, n, k))
    for i in range(n):
        h = half[i]
        for j in range(k):
            value = parts[i, 0, j]
            first, mixed, second = parts[i, 3, j], abs(parts[i, 4, j]), parts[i, 5, j]
            linear = h * (abs(parts[i, 1, j]) + abs(parts[i, 2, j]))
            curved = h**2 * (abs(first) + mixed + abs(second)) + remainder[i, j]
            # Squares bend to one side alone: max(q, 0) is (|q| + q) / 2.
            up = h**2 * ((abs(first) + first) / 2 + (abs(second) + second) / 2 + mixed)
            down = h**2 * ((abs(first) - first) / 2 + (abs(second) - second) / 2 + mixed)
            found[LINEAR, i, j] = linear
            found[CURVED, i, j] = curved
            down = (1 + SLACK) * (linear + (down + remainder[i, j])) + SLACK * abs(value)
            up = (1 + SLACK) * (linear + (up + remainder[i, j])) + SLACK * abs(value)
            found[LOWER, i, j] = value - down
            found[UPPER, i, j] = value + up
            found[MAGNITUDE, i, j] = abs(value) + (1 + SLACK) * (linear + curved)
    return found


@kernel
def product(
    a: FloatArray,
    a_ranges: FloatArray,
    a_rest: FloatArray,
    b: FloatArray,
    b_ranges: FloatArray,
    b_rest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Returns the parts and remainders of products; one function multiplies all others."""
    n, k = len(a), max(a.shape[2], b.shape[2])
    parts, remainder = np.empty((n, 6, k)), np.empty((n, k))
    for i in range(n):
        for j in range(k):
            p, q = min(j, a.shape[2] - 1), min(j, b.shape[2] - 1)
            u, v = a[i, 0, p], b[i, 0, q]
            u0, u1, v0, v1 = a[i, 1, p], a[i, 2, p], b[i, 1, q], b[i, 2, q]
            parts[i, 0, j] = u * v
            parts[i, 1, j] = u * v0 + v * u0
            parts[i, 2, j] = u * v1 + v * u1
            parts[i, 3, j] = u * b[i, 3, q] + v * a[i, 3, p] + u0 * v0
            parts[i, 4, j] = u * b[i, 4, q] + v * a[i, 4, p] + (u0 * v1 + u1 * v0)
            parts[i, 5, j] = u * b[i, 5, q] + v * a[i, 5, p] + u1 * v1
            curved = b_ranges[CURVED, i, q]
            rest = abs(u) * b_rest[i, q] + abs(v) * a_rest[i, p]
            rest += a_ranges[LINEAR, i, p] * curved
            rest += a_ranges[CURVED, i, p] * (b_ranges[LINEAR, i, q] + curved)
            size = a_ranges[MAGNITUDE, i, p] * b_ranges[MAGNITUDE, i, q]
            remainder[i, j] = (1 + SLACK) * rest + SLACK * size + TINY
    return parts, remainder


@kernel
def composed(
    half: FloatArray,
    parts: FloatArray,
    own_ranges: FloatArray,
    about: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    curvature: FloatArray,
    rest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Returns the parts of functions of functions, and what these leave out.

    That is besides the slope times the remainder of the argument, (n, k).

    Args:
        half: (n,) of the squares.
        parts: (n, 6, k) of the arguments.
        own_ranges: Their `ranges`.
        about: (n, k) what the expansions are about: the arguments' values, or near them.
        value: (n, k) of the expansions, as the following; see `Expansion`.
        slope: The factor of t.
        curvature: That of t^2 / 2.
        rest: A bound of what is left.
    """
    n, _, k = parts.shape
    found, own = np.empty((n, 6, k)), np.empty((n, k))
    for i in range(n):
        h = half[i]
        for j in range(k):
            s, bend = slope[i, j], curvature[i, j] / 2
            u0, u1 = parts[i, 1, j], parts[i, 2, j]
            s0, s1 = s * u0, s * u1
            first = s * parts[i, 3, j] + bend * (u0 * u0)
            mixed = s * parts[i, 4, j] + bend * (u0 * u1 + u1 * u0)
            second = s * parts[i, 5, j] + bend * (u1 * u1)
            found[i, 0, j], found[i, 1, j], found[i, 2, j] = value[i, j], s0, s1
            found[i, 3, j], found[i, 4, j], found[i, 5, j] = first, mixed, second
            off = abs(parts[i, 0, j] - about[i, j])
            linear, curved = own_ranges[LINEAR, i, j], own_ranges[CURVED, i, j] + off
            # t^2 less the square of its linear part.
            beyond = abs(bend) * curved * (2 * linear + curved)
            left = rest[i, j] + beyond + abs(s) * off
            size = h * (abs(s0) + abs(s1)) + h**2 * (abs(first) + abs(mixed) + abs(second))
            size = abs(value[i, j]) + (1 + SLACK) * size + abs(s) * curved + left
            own[i, j] = (1 + SLACK) * left + SLACK * size + TINY
    return found, own


@kernel
def silu(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns u / (1 + exp(-u)) and its first two derivatives, (n, k) each."""
    value, slope, curvature = np.empty_like(u), np.empty_like(u), np.empty_like(u)
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            t = u[i, j]
            gate = 0.5 + 0.5 * np.tanh(0.5 * t)
            bell = gate * (1 - gate)
            value[i, j] = t * gate
            slope[i, j] = gate + t * bell
            curvature[i, j] = bell * (2 + t * (1 - 2 * gate))
    return value, slope, curvature


@kernel
def cubic_rests(
    u: FloatArray,
    low: FloatArray,
    high: FloatArray,
    curvature: FloatArray,
    bounds: tuple[float, float, float],
    error: float,
    growth: float,
) -> FloatArray:
    """Returns what second-order expansions of a function about u leave on [low, high], (n, k).

    Args:
        u: (n, k), as the following.
        low: Of the intervals.
        high: Of the intervals.
        curvature: The second derivatives at u.
        bounds: Of the second derivative, from below and above, and of |the third|.
        error: What rounding changes the value and the derivatives at u by.
        growth: What it changes them by beyond, times |u|.
    """
    least, most, third = bounds
    rests = np.empty_like(u)
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            t, c = u[i, j], curvature[i, j]
            # A sum where one of the two is the larger, so that what is no number shows.
            reach = max(high[i, j] - t, t - low[i, j]) + 0 * (high[i, j] - low[i, j])
            anywhere = max(abs(c - least), abs(most - c))
            rest = min(third * (reach / 3 + TINY), anywhere) * reach**2 / 2
            rounding = (error + growth * abs(t)) * (1 + reach + reach**2 / 2)
            rests[i, j] = (1 + error) * rest + rounding + TINY
    return rests


# exp is zero in float64 below minus this; what is below LEAST counts as that.
UNDERFLOW, LEAST = 746.0, -690.0
# A weight that grows to the exponential of more says nothing any more, and would overflow.
LARGEST = 500.0


@kernel
def log_sums(
    centers: FloatArray, half: FloatArray, points: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Returns log sum_i exp(-|x - x_i|^2 / 2 sigma^2) of the nearest and the farthest x.

    Each waypoint for itself: the nearest and the farthest that it can be over a square.

    Args:
        centers: (n, 2) of the squares.
        half: (n,) of the squares.
        points: (N, 2) x_i.
        sigma: Noise level.

    Returns:
        (n, 2) the largest terms' exponents and (n, 2) the logarithms of the sums over those
        terms, nearest first.
    """
    n, count, factor = len(half), len(points), -1 / (2 * sigma**2)
    tops, logarithms = np.empty((n, 2)), np.empty((n, 2))
    exponents = np.empty((2, count))
    for i in range(n):
        h = half[i]
        tops[i] = -np.inf
        for p in range(count):
            x, y = abs(centers[i, 0] - points[p, 0]), abs(centers[i, 1] - points[p, 1])
            near_x, near_y = max(x - h, 0.0), max(y - h, 0.0)
            exponents[0, p] = factor * (near_x**2 + near_y**2)
            exponents[1, p] = factor * ((x + h) ** 2 + (y + h) ** 2)
            tops[i, 0] = max(tops[i, 0], exponents[0, p])
            tops[i, 1] = max(tops[i, 1], exponents[1, p])
        for side in range(2):
            total = 0.0
            for p in range(count):
                exponent = exponents[side, p] - tops[i, side]
                if exponent > LEAST:
                    total += np.exp(exponent)
            logarithms[i, side] = np.log(total)
    return tops, logarithms


@kernel
def tilted_means(
    centers: FloatArray, half: FloatArray, points: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Returns the models of x - m, with the mean m of the waypoints by their weights at x.

    See `mixture_model`.  The tilted weights are w_i exp(a_i) / Z, with Z = sum_i w_i exp(a_i)
    at least one, since E a = 0 (Jensen).  By the logarithms, since a weight that is zero to
    float64 at the centre may be all that counts in a corner.

    Args:
        centers: (n, 2) of the squares.
        half: (n,) of the squares.
        points: (N, 2) the waypoints.
        sigma: Noise level.

    Returns:
        The parts (n, 6, 2); what the third derivative of the mean adds, (n, 2), and E|y_k|,
        (n, 2), of tilted weights; and the largest terms' exponents (n,).
    """
    n, count, variance = len(half), len(points), sigma**2
    parts = np.empty((n, 6, 2))
    change, spread, tops = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    logarithms, weights, grown = np.empty(count), np.empty(count), np.empty(count)
    y = np.empty((2, count))
    for i in range(n):
        top = -np.inf
        for p in range(count):
            y[0, p], y[1, p] = points[p, 0] - centers[i, 0], points[p, 1] - centers[i, 1]
            logarithms[p] = (y[0, p] ** 2 + y[1, p] ** 2) / (-2 * variance)
            top = max(top, logarithms[p])
        total = 0.0
        for p in range(count):
            logarithms[p] -= top
            weights[p] = np.exp(logarithms[p]) if logarithms[p] > LEAST else 0.0
            total += weights[p]
        log_total = np.log(total)
        mean_x, mean_y, farthest = 0.0, 0.0, 0.0
        for p in range(count):
            weights[p] /= total
            logarithms[p] -= log_total
            farthest = max(farthest, -logarithms[p])
            mean_x += weights[p] * y[0, p]
            mean_y += weights[p] * y[1, p]
        # Covariance, third moments, and the weights that grow most.
        xx = xy = yy = xxx = xxy = xyy = yyy = sum_grown = 0.0
        step, error = half[i] / variance, 32 * UNIT * farthest
        for p in range(count):
            y[0, p] -= mean_x
            y[1, p] -= mean_y
            u, v, w = y[0, p], y[1, p], weights[p]
            xx += w * u * u
            xy += w * u * v
            yy += w * v * v
            xxx += w * u * u * u
            xxy += w * u * u * v
            xyy += w * u * v * v
            yyy += w * v * v * v
            exponent = logarithms[p] + step * (abs(u) + abs(v)) + error
            if exponent > LARGEST:
                grown[p] = np.inf
            else:
                grown[p] = np.exp(exponent) if exponent > LEAST else 0.0
            sum_grown += grown[p]
        # Where the mean moves to: weights change by a factor between exp(-tilt) / Z and
        # exp(tilt).
        moved_x = moved_y = 0.0
        for p in range(count):
            u, v, w = abs(y[0, p]), abs(y[1, p]), weights[p]
            if grown[p] > 0:
                shrunk = w * np.exp(-step * (u + v)) / sum_grown
                most = max(grown[p] - w, w - shrunk)
                moved_x += most * u
                moved_y += most * v
        # The fourth joint cumulant, E[Y a^3] - 3 E[Y a] E[a^2], by absolute moments.
        square = first_x = first_y = fourth_x = fourth_y = spread_x = spread_y = 0.0
        for p in range(count):
            u, v, g = abs(y[0, p]), abs(y[1, p]), grown[p]
            about_x, about_y = u + moved_x, v + moved_y
            tilt = step * (about_x + about_y)
            once, twice = g * tilt, g * tilt * tilt
            square += twice
            first_x += once * about_x
            first_y += once * about_y
            fourth_x += twice * tilt * about_x
            fourth_y += twice * tilt * about_y
            spread_x += g * u
            spread_y += g * v
        tops[i] = top
        parts[i, 0, 0], parts[i, 0, 1] = -mean_x, -mean_y
        parts[i, 1, 0], parts[i, 2, 1] = 1 - xx / variance, 1 - yy / variance
        parts[i, 1, 1] = parts[i, 2, 0] = -xy / variance
        bend = -1 / (2 * variance**2)
        parts[i, 3, 0], parts[i, 3, 1] = bend * xxx, bend * xxy
        parts[i, 4, 0], parts[i, 4, 1] = 2 * bend * xxy, 2 * bend * xyy
        parts[i, 5, 0], parts[i, 5, 1] = bend * xyy, bend * yyy
        change[i, 0] = (fourth_x + 3 * first_x * square) / 6
        change[i, 1] = (fourth_y + 3 * first_y * square) / 6
        spread[i, 0], spread[i, 1] = spread_x, spread_y
    return parts, change, spread, tops
