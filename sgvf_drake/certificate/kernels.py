"""The inner loops of Taylor models, compiled: one pass over memory where NumPy takes twenty.

The parts of a model are (n, 1 + k + k (k + 1) / 2, f): for each of n patches of k parameters
and f functions the value, the k slopes, and the factors of u_a u_b for a <= b, in the order
(0, 0), (0, 1), ..., (1, 1), ...  Functions come last, so that the innermost loops go over them
and need not know k.  Nothing here compares with what may not be a number: sums and absolute
values hand it on, so that it is not below any bound later.

The constants stand here, since a change of what a kernel takes from elsewhere does not reach
the cache of compiled code.
"""

import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import accumulating_part, kernel, part

UNIT = 2.0**-53
"""The unit roundoff of float64."""

ROUNDINGS = 32
"""More than the roundings one after another in any operation on scalars here."""

SLACK = 2 * ROUNDINGS * UNIT
"""What the roundings of an operation change its result by, at most, relative to the sum of the
magnitudes that are added in it: n of them make (1 + UNIT)^n - 1, which is below 2 n UNIT."""

TINY = 1e-290
"""Above what underflow can change a result by."""

LIBRARY = 8
"""Units of roundoff, relative to their value, that elementary functions are off by at most."""


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


def num_parameters(rows: int) -> int:
    """Returns the number k of parameters of models of 1 + k + k (k + 1) / 2 parts."""
    # That is (k + 1) (k + 2) / 2, and twice that is between (k + 1)^2 and (k + 2)^2.
    return int(np.sqrt(2 * rows)) - 1


_num_parameters = part(num_parameters)


@kernel
def ranges(parts: FloatArray, remainder: FloatArray) -> FloatArray:
    """Returns how far functions go over their patches, (5, n, f).

    How far their linear part and all the rest take them from their value, at most; what they
    are at least and at most; and what their absolute values and those of their parts are.
    """
    n, rows, f = parts.shape
    k = _num_parameters(rows)
    found = np.zeros((5, n, f))
    for i in range(n):
        linear, curved = found[LINEAR, i], found[CURVED, i]
        low, high, size = found[LOWER, i], found[UPPER, i], found[MAGNITUDE, i]
        q = k
        for a in range(k):
            for j in range(f):
                linear[j] += abs(parts[i, 1 + a, j])
            # Squares bend to one side alone: max(q, 0) is (|q| + q) / 2.
            q += 1
            for j in range(f):
                square = parts[i, q, j]
                curved[j] += abs(square)
                high[j] += (abs(square) + square) / 2
                low[j] += (abs(square) - square) / 2
            for _ in range(a + 1, k):
                q += 1
                for j in range(f):
                    mixed = abs(parts[i, q, j])
                    curved[j] += mixed
                    high[j] += mixed
                    low[j] += mixed
        for j in range(f):
            value, rest = parts[i, 0, j], remainder[i, j]
            curved[j] += rest
            rounding = SLACK * abs(value)
            low[j] = value - ((1 + SLACK) * (linear[j] + (low[j] + rest)) + rounding)
            high[j] = value + ((1 + SLACK) * (linear[j] + (high[j] + rest)) + rounding)
            size[j] = (1 + SLACK) * (abs(value) + linear[j] + curved[j])
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
    n, rows, f = len(a), a.shape[1], max(a.shape[2], b.shape[2])
    k = _num_parameters(rows)
    a_step, b_step = min(a.shape[2] - 1, 1), min(b.shape[2] - 1, 1)
    parts, remainder = np.empty((n, rows, f)), np.empty((n, f))
    for i in range(n):
        for j in range(f):
            parts[i, 0, j] = a[i, 0, a_step * j] * b[i, 0, b_step * j]
        for r in range(1, rows):
            for j in range(f):
                p, q = a_step * j, b_step * j
                parts[i, r, j] = a[i, 0, p] * b[i, r, q] + b[i, 0, q] * a[i, r, p]
        r = k
        for x in range(1, k + 1):
            r += 1
            for j in range(f):
                parts[i, r, j] += a[i, x, a_step * j] * b[i, x, b_step * j]
            for y in range(x + 1, k + 1):
                r += 1
                for j in range(f):
                    p, q = a_step * j, b_step * j
                    parts[i, r, j] += a[i, x, p] * b[i, y, q] + a[i, y, p] * b[i, x, q]
        for j in range(f):
            p, q = a_step * j, b_step * j
            curved = b_ranges[CURVED, i, q]
            rest = abs(a[i, 0, p]) * b_rest[i, q] + abs(b[i, 0, q]) * a_rest[i, p]
            rest += a_ranges[LINEAR, i, p] * curved
            rest += a_ranges[CURVED, i, p] * (b_ranges[LINEAR, i, q] + curved)
            size = a_ranges[MAGNITUDE, i, p] * b_ranges[MAGNITUDE, i, q]
            remainder[i, j] = (1 + SLACK) * rest + SLACK * size + TINY
    return parts, remainder


@kernel
def weighted_sum(
    parts: FloatArray, own_ranges: FloatArray, remainder: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the models (n, 1) of sums of functions times weights, (n or 1, f)."""
    n, rows, f = parts.shape
    step = min(len(weights) - 1, 1)
    found, rests = np.zeros((n, rows, 1)), np.empty((n, 1))
    for i in range(n):
        for r in range(rows):
            for j in range(f):
                found[i, r, 0] += weights[step * i, j] * parts[i, r, j]
        rest = size = 0.0
        for j in range(f):
            weight = abs(weights[step * i, j])
            rest += weight * remainder[i, j]
            size += weight * own_ranges[MAGNITUDE, i, j]
        rests[i, 0] = (1 + SLACK) * rest + SLACK * size + TINY
    return found, rests


@part
def _compose(
    i: int,
    parts: FloatArray,
    own_ranges: FloatArray,
    about: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    curvature: FloatArray,
    rest: FloatArray,
    own: FloatArray,
    size: FloatArray,
) -> None:
    """Makes the parts over a patch, i, those of functions of them, in place; see `composed`.

    What these leave out goes to `own`, and what they are summed up from, at most, to `size`.
    """
    _, rows, f = parts.shape
    k = _num_parameters(rows)
    for j in range(f):
        off, bend = abs(parts[i, 0, j] - about[i, j]), abs(curvature[i, j]) / 2
        linear, curved = own_ranges[LINEAR, i, j], own_ranges[CURVED, i, j] + off
        steep = abs(slope[i, j])
        # t^2 less the square of its linear part.
        left = rest[i, j] + bend * curved * (2 * linear + curved) + steep * off
        added = abs(value[i, j]) + steep * (linear + curved) + bend * linear**2
        own[i, j] = (1 + SLACK) * left + SLACK * (added + left) + TINY
        size[i, j] = added
    # Slopes last, since the rows of squares ask for them.
    r = k
    for x in range(1, k + 1):
        r += 1
        for j in range(f):
            square = curvature[i, j] / 2 * parts[i, x, j] ** 2
            parts[i, r, j] = slope[i, j] * parts[i, r, j] + square
        for y in range(x + 1, k + 1):
            r += 1
            for j in range(f):
                mixed = curvature[i, j] * (parts[i, x, j] * parts[i, y, j])
                parts[i, r, j] = slope[i, j] * parts[i, r, j] + mixed
    for x in range(1, k + 1):
        for j in range(f):
            parts[i, x, j] *= slope[i, j]
    for j in range(f):
        parts[i, 0, j] = value[i, j]


@kernel
def composed(
    parts: FloatArray,
    own_ranges: FloatArray,
    about: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    curvature: FloatArray,
    rest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Returns the parts of functions of functions, and what these leave out.

    That is besides the slope times the remainder of the argument, (n, f).

    Args:
        parts: The parts of the arguments.
        own_ranges: Their `ranges`.
        about: (n, f) what the expansions are about: the arguments' values, or near them.
        value: (n, f) of the expansions, as the following; see `Expansion`.
        slope: The factor of t.
        curvature: That of t^2 / 2.
        rest: A bound of what is left.
    """
    n, _, f = parts.shape
    found, own, size = parts.copy(), np.empty((n, f)), np.empty((n, f))
    for i in range(n):
        _compose(i, found, own_ranges, about, value, slope, curvature, rest, own, size)
    return found, own


@kernel
def shift_layer(
    parts: FloatArray,
    remainder: FloatArray,
    largest: FloatArray,
    bias: FloatArray,
    sizes: FloatArray,
    gamma: float,
) -> FloatArray:
    """Makes the models of the units before a layer, times a matrix, those of its arguments.

    Parts and remainders change in place.

    Args:
        parts: The parts of the units, times the matrix.
        remainder: (n, f) their remainders, times its absolute values.
        largest: (n,) what the units and their parts are at most.
        bias: (f,) what is added.
        sizes: (f,) the sums of the absolute values of the matrix.
        gamma: What a sum is off by, at most, relative to that of the magnitudes.

    Returns:
        What the rounding of each adds, at most, (n, f).
    """
    n, _, f = parts.shape
    rounding = np.empty((n, f))
    for i in range(n):
        for j in range(f):
            parts[i, 0, j] += bias[j]
            rounding[i, j] = gamma * (largest[i] * sizes[j] + abs(bias[j])) + TINY
            remainder[i, j] = (1 + gamma) * remainder[i, j] + rounding[i, j]
    return rounding


@kernel
def bend_layer(
    parts: FloatArray,
    own_ranges: FloatArray,
    remainder: FloatArray,
    rounding: FloatArray,
    about: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    curvature: FloatArray,
    rest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Makes the models of the arguments of a layer those of its units, in place.

    Args:
        parts: As of `composed`, and the following.
        own_ranges: The same.
        remainder: (n, f) the remainders.
        rounding: (n, f) what the last affine map added to these.
        about: As of `composed`, and the following.
        value: The same.
        slope: The same.
        curvature: The same.
        rest: The same.

    Returns:
        What the curves and the rounding of a layer add to each unit at most, (n, f), and what
        the units and their parts are at most, (n, f).
    """
    n, _, f = parts.shape
    own, size = np.empty((n, f)), np.empty((n, f))
    for i in range(n):
        _compose(i, parts, own_ranges, about, value, slope, curvature, rest, own, size)
        for j in range(f):
            steep = abs(slope[i, j])
            remainder[i, j] = (1 + SLACK) * (steep * remainder[i, j] + own[i, j])
            own[i, j] = (1 + SLACK) * (own[i, j] + steep * rounding[i, j])
            size[i, j] = (1 + SLACK) * (size[i, j] + remainder[i, j])
    return own, size


@kernel
def carry_back(
    backward: FloatArray,
    size: FloatArray,
    gamma: float,
    slope: FloatArray,
    own: FloatArray,
    total: FloatArray,
) -> None:
    """Adds what the errors of a layer make of outputs, and goes back to its arguments.

    Args:
        backward: (n, o, f) what the units of the layer make of each of o outputs; in place,
            what the arguments of the layer do.
        size: (o, f) against which the first is rounded.
        gamma: What it is off by, relative to that.
        slope: (n, f) of the units.
        own: (n, f) what a unit adds, at most.
        total: (n, o) what errors make of the outputs, which grows.
    """
    n, outputs, f = backward.shape
    reached = np.empty(f)
    for i in range(n):
        for o in range(outputs):
            for j in range(f):
                reached[j] = (abs(backward[i, o, j]) + gamma * size[o, j]) * own[i, j]
                backward[i, o, j] *= slope[i, j]
            total[i, o] += _sum(reached)


@part
def _sum(values: FloatArray) -> float:
    """Returns the sum of values, which it takes the place of: of halves that are added up."""
    count = len(values)
    while count > 1:
        half = (count + 1) // 2
        for j in range(count - half):
            values[j] += values[half + j]
        count = half
    return values[0]


# exp(x) = 2^n exp(r) with x = n log 2 + r.  The first part of log 2 has 32 digits, so that n
# times it is exact, and so is x less that.  What the second leaves of log 2 is below 2e-26.
_PER_LOG_2, _LOG_2, _REST = 1 / math.log(2), 5954088942.0 * 2.0**-33, 1.9082149292705877e-10
# Added to a whole number, it leaves that in the last digits; the place of the exponent in a
# number, and what is added to it there.
_WHOLE, _EXPONENT, _BIAS = 1.5 * 2.0**52, 52, 1023
_FARTHEST = 700.0


@accumulating_part
def _exponentials(x: FloatArray, scale: FloatArray, found: FloatArray) -> None:
    """Makes the exponentials of numbers, many at once; what is beyond +-700 counts as that.

    They are right within 4 units of roundoff.  The series up to r^13 leaves less than 5e-18
    where |r| < .347, and r is off by .35 units.  In Horner's scheme the last step adds less
    than exp(r) + |exp(r) - 1| units, that before |r| times 1.4, and all others a tenth; and
    exp(r) is above .7.  The power of two is exact.

    Args:
        x: (f,).
        scale: (f,) for use meanwhile.
        found: (f,) the exponentials.
    """
    bits = scale.view(np.int64)
    for j in range(len(x)):
        scale[j] = min(max(x[j], -_FARTHEST), _FARTHEST) * _PER_LOG_2 + _WHOLE
    for j in range(len(x)):
        n = scale[j] - _WHOLE
        r = (min(max(x[j], -_FARTHEST), _FARTHEST) - n * _LOG_2) - n * _REST
        total = 1 / 6227020800
        total = total * r + 1 / 479001600
        total = total * r + 1 / 39916800
        total = total * r + 1 / 3628800
        total = total * r + 1 / 362880
        total = total * r + 1 / 40320
        total = total * r + 1 / 5040
        total = total * r + 1 / 720
        total = total * r + 1 / 120
        total = total * r + 1 / 24
        total = total * r + 1 / 6
        total = total * r + 1 / 2
        total = total * r + 1
        found[j] = total * r + 1
    for j in range(len(x)):
        bits[j] = (bits[j] + _BIAS) << _EXPONENT
    for j in range(len(x)):
        found[j] *= scale[j]


@kernel
def silu(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns u / (1 + exp(-u)) and its first two derivatives, (n, k) each."""
    value, slope, curvature = np.empty_like(u), np.empty_like(u), np.empty_like(u)
    opposite, scale, decay = np.empty(u.shape[1]), np.empty(u.shape[1]), np.empty(u.shape[1])
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            opposite[j] = -u[i, j]
        _exponentials(opposite, scale, decay)
        for j in range(u.shape[1]):
            t = u[i, j]
            gate = 1 / (1 + decay[j])
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
# A weight whose logarithm is below is left out of means, and what that changes is bounded.
NEGLIGIBLE = -64.0
# A weight that grows to the exponential of more says nothing any more, and would overflow.
LARGEST = 500.0


@kernel
def log_sums(
    centers: FloatArray, half: FloatArray, points: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Returns log sum_i exp(-|x - x_i|^2 / 2 sigma^2) of the nearest and the farthest x.

    Each waypoint for itself: the nearest and the farthest that it can be over a square.

    Args:
        centers: (n, d) of the squares.
        half: (n,) of the squares.
        points: (N, d) x_i.
        sigma: Noise level.

    Returns:
        (n, 2) the largest terms' exponents and (n, 2) the logarithms of the sums over those
        terms, nearest first.
    """
    n, count, factor = len(half), len(points), -1 / (2 * sigma**2)
    tops, logarithms = np.full((n, 2), -np.inf), np.empty((n, 2))
    exponents = np.empty((2, count))
    for i in range(n):
        for p in range(count):
            near = far = 0.0
            for c in range(points.shape[1]):
                apart = abs(centers[i, c] - points[p, c])
                near += max(apart - half[i], 0.0) ** 2
                far += (apart + half[i]) ** 2
            exponents[0, p], exponents[1, p] = factor * near, factor * far
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
    centers: FloatArray,
    axes: FloatArray,
    points: FloatArray,
    exponents: FloatArray,
    values: FloatArray,
    sigma: float,
    products: bool,
) -> tuple[FloatArray, FloatArray]:
    """Returns models of means by the weights exp(-|x - x_i|^2 / 2 sigma^2 + exponent_i).

    See `mixture_model`.

    Args:
        centers: c, (n, d) of the patches.
        axes: A, (n, d, k) of the patches.
        points: x_i, (N, d).
        exponents: (N,).
        values: (N, f) what is averaged besides x_i - c; right within 64 units of roundoff of
            one, whatever their size.
        sigma: Noise level.
        products: Whether the products of all these with each entry of x_i - c are averaged
            too, of both less their means at c.

    Returns:
        The parts (n, 1 + k + k (k + 1) / 2, d + f, or with products (d + f) (1 + d)), and the
        remainders.
    """
    (n, d, k), (count, f) = axes.shape, values.shape
    base, variance = d + f, sigma**2
    columns = base * (1 + d) if products else base
    parts = np.zeros((n, 1 + k + k * (k + 1) // 2, columns))
    remainder = np.empty((n, columns))
    F, size = np.empty((columns, count)), np.empty((columns, count))
    b, tilts = np.empty((k, count)), np.empty(count)
    logarithms, weights, grown = np.empty(count), np.empty(count), np.empty(count)
    largest, reach = np.abs(exponents).max(), np.empty(columns)
    for i in range(n):
        for p in range(count):
            logarithms[p] = exponents[p] - _square(points[p], centers[i]) / (2 * variance)
        m = _select(points, values, centers[i], axes[i], variance, logarithms, F, reach)
        logs, w, t, g = logarithms[:m], weights[:m], tilts[:m], grown[:m]
        top, farthest = _weigh(logs, w)
        _centre(F, size, w, parts[i, 0], d, base)
        _project(F, size, axes[i], variance, b, t)
        if products:
            _multiply(F, size, w, parts[i, 0], d, reach)
        _cumulants(F, b, w, parts[i])
        # Weights are off by the roundings of their exponents, and by those of their sum.
        exponent = abs(top) + 2 * largest + farthest
        off = UNIT * (16 * exponent + 4 * (count + 2 * LIBRARY))
        error = 32 * UNIT * farthest + off * (1 + (w * t).sum())
        sum_grown = _grow(b, t, logs, error, g)
        _rests(F, size, b, t, w, g, sum_grown, off, remainder[i])
        for c in range(columns):
            remainder[i, c] += 4 * count * np.exp(NEGLIGIBLE + 1) * reach[c]
    return parts, remainder


@part
def _square(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for c in range(len(a)):
        total += (a[c] - b[c]) ** 2
    return total


@part
def _select(
    points: FloatArray,
    values: FloatArray,
    center: FloatArray,
    axes: FloatArray,
    variance: float,
    logarithms: FloatArray,
    F: FloatArray,
    reach: FloatArray,
) -> int:
    """Puts what counts on a patch, its logarithms and x_i - c and values, to the front.

    The weight of x_i over that of the nearest waypoint is there at most exp(l_i - l + sum_j
    |A_j . (x_i - x)| / sigma^2).  What is left out is below exp(NEGLIGIBLE), also after
    rounding below e times that, and so changes a mean by less than 4 N such parts of `reach`.

    Returns:
        The number of what counts.
    """
    (d, k), f, m = axes.shape, values.shape[1], 0
    reach[:] = 0.0
    nearest = np.argmax(logarithms)
    top = logarithms[nearest]
    for p in range(len(points)):
        exponent = logarithms[p] - top
        for j in range(k):
            along = 0.0
            for c in range(d):
                along += axes[c, j] * (points[p, c] - points[nearest, c])
            exponent += abs(along) / variance
        for c in range(d):
            F[c, m] = points[p, c] - center[c]
            reach[c] = max(reach[c], abs(F[c, m]))
        for c in range(f):
            F[d + c, m] = values[p, c]
            reach[d + c] = max(reach[d + c], abs(values[p, c]))
        # Also what is no number counts.
        if not exponent < NEGLIGIBLE:
            logarithms[m] = logarithms[p]
            m += 1
    return m


@accumulating_part
def _weigh(logarithms: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Makes weights of sum one of logarithms, and their logarithms.

    Returns:
        The largest logarithm, and how far below zero the least one is of those weights.
    """
    top, total, farthest = logarithms.max(), 0.0, 0.0
    for p in range(len(logarithms)):
        logarithms[p] -= top
        weights[p] = np.exp(logarithms[p]) if logarithms[p] > LEAST else 0.0
        total += weights[p]
    shift = np.log(total)
    for p in range(len(logarithms)):
        logarithms[p] -= shift
        weights[p] /= total
        farthest = max(farthest, -logarithms[p])
    return top, farthest


@accumulating_part
def _centre(
    F: FloatArray, size: FloatArray, weights: FloatArray, means: FloatArray, d: int, base: int
) -> None:
    """Takes the means off, and tells the sizes against which the weights are off.

    What comes after x_i - c is itself off by rounding, relative to one.
    """
    for c in range(base):
        mean, least = 0.0, 0.0 if c < d else 1.0
        for p in range(len(weights)):
            mean += weights[p] * F[c, p]
        means[c] = mean
        for p in range(len(weights)):
            value = F[c, p]
            F[c, p] = value - mean
            size[c, p] = least + abs(value) + abs(value - mean)


@accumulating_part
def _project(
    F: FloatArray,
    size: FloatArray,
    axes: FloatArray,
    variance: float,
    b: FloatArray,
    tilts: FloatArray,
) -> None:
    """Makes b_j = A_j . y / sigma^2, and the sizes of what all of them are summed up from."""
    b[:], tilts[:] = 0.0, 0.0
    for c in range(axes.shape[0]):
        for j in range(axes.shape[1]):
            factor = axes[c, j] / variance
            for p in range(len(tilts)):
                b[j, p] += factor * F[c, p]
                tilts[p] += abs(factor) * size[c, p]


@accumulating_part
def _multiply(
    F: FloatArray,
    size: FloatArray,
    weights: FloatArray,
    means: FloatArray,
    d: int,
    reach: FloatArray,
) -> None:
    """Makes the products of all columns with the first d, less their means."""
    base = len(F) // (1 + d)
    for c in range(base):
        for e in range(d):
            to, mean = base + c * d + e, 0.0
            for p in range(len(weights)):
                F[to, p] = F[c, p] * F[e, p]
                mean += weights[p] * F[to, p]
            # Less their means, both reach twice as far.
            means[to], reach[to] = mean, 4 * reach[c] * reach[e]
            for p in range(len(weights)):
                F[to, p] -= mean
                size[to, p] = size[c, p] * size[e, p] + abs(mean)


@accumulating_part
def _cumulants(F: FloatArray, b: FloatArray, weights: FloatArray, parts: FloatArray) -> None:
    """Makes the slopes E[F b_j] and the factors of u_j u_l: of E[F b_j b_l], half if j = l."""
    k = len(b)
    for c in range(len(F)):
        q = k
        for j in range(k):
            for p in range(len(weights)):
                parts[1 + j, c] += weights[p] * F[c, p] * b[j, p]
            for m in range(j, k):
                q += 1
                total = 0.0
                for p in range(len(weights)):
                    total += weights[p] * F[c, p] * (b[j, p] * b[m, p])
                parts[q, c] = total / 2 if m == j else total


@accumulating_part
def _grow(
    b: FloatArray, tilts: FloatArray, logarithms: FloatArray, error: float, grown: FloatArray
) -> float:
    """Makes what the weights are at most all over a patch, and their sum.

    The tilted weights are w_i exp(b_i . u) / Z, and Z = sum_i w_i exp(b_i . u) is at least one,
    since E b = 0 (Jensen).  By the logarithms, since a weight that is zero to float64 at the
    centre may be all that counts in a corner.
    """
    total = 0.0
    for p in range(len(grown)):
        tilt = 0.0
        for j in range(len(b)):
            tilt += abs(b[j, p])
        exponent = logarithms[p] + tilt + (error + SLACK * tilts[p])
        if exponent > LARGEST:
            grown[p] = np.inf
        else:
            grown[p] = np.exp(exponent) if exponent > LEAST else 0.0
        total += grown[p]
    return total


@accumulating_part
def _rests(
    F: FloatArray,
    size: FloatArray,
    b: FloatArray,
    tilts: FloatArray,
    weights: FloatArray,
    grown: FloatArray,
    sum_grown: float,
    off: float,
    remainder: FloatArray,
) -> None:
    """Makes the remainders: what third derivatives add, and the rounding.

    A sixth of the joint cumulant E[F a^3] - 3 E[F a] E[a^2] of F and three a = b . u, at any
    u, by absolute moments; about the means there.
    """
    k, count = len(b), len(weights)
    change, a = np.empty(count), np.empty(count)
    for p in range(count):
        tilt = 0.0
        for j in range(k):
            tilt += abs(b[j, p])
        a[p] = tilt
        # Weights change by a factor between exp(-tilt) / Z and exp(tilt).
        shrunk = weights[p] * np.exp(-tilt) / sum_grown
        change[p] = max(grown[p] - weights[p], weights[p] - shrunk)
    for j in range(k):
        a += _moved(b[j], change)
    square = spread = 0.0
    for p in range(count):
        square += grown[p] * a[p] ** 2
        spread += grown[p] * (tilts[p] + tilts[p] ** 2)
    for c in range(len(F)):
        moved = _moved(F[c], change)
        first = fourth = rounding = 0.0
        for p in range(count):
            once = grown[p] * (abs(F[c, p]) + moved) * a[p]
            first += once
            fourth += once * a[p] ** 2
            rounding += grown[p] * size[c, p] * (1 + tilts[p] + tilts[p] ** 2)
        rest = (fourth + 3 * first * square) / 6
        remainder[c] = (1 + SLACK) * rest + 4 * off * rounding * (1 + spread) + TINY


@accumulating_part
def _moved(values: FloatArray, change: FloatArray) -> float:
    """What the mean of values moves by at most, as their weights change."""
    total = 0.0
    for p in range(len(change)):
        total += abs(values[p]) * change[p]
    return total
