"""Ball arithmetic (Arb, by python-flint): what the models are held against.

A float64 becomes the ball of itself, and every result holds the true value.
"""

from itertools import combinations_with_replacement, product

from flint import arb, arb_series, ctx
import numpy as np

from sgvf_drake.certificate.patches import Patches
from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_POWER,
    PROJECTION_RANGE,
    UNIT_SOFTENING,
    NormalisedComposition,
    PaperComposition,
)
from sgvf_drake.fields.strands import ONE_WAY_SHARPNESS, TWO_WAY_SHARPNESS

ctx.prec = 256


def sigmoid(z):
    return 1 / (1 + (-z).exp())


def sech(z):
    decay = (-z).exp()
    return 2 * decay / (1 + decay * decay)


def gelu(z):
    return z * (1 + (z / arb(2).sqrt()).erf()) / 2


FUNCTIONS = {
    "SiLU": lambda z: z * sigmoid(z),
    "Tanh": lambda z: 2 * sigmoid(2 * z) - 1,
    "Sigmoid": sigmoid,
    "Softplus": lambda z: (1 + z.exp()).log(),
    "GELU": gelu,
    "sine": lambda z: z.sin(),
    "cosine": lambda z: z.cos(),
    "fall": lambda z: 1 / (1 + z**4),
}
"""Smooth functions, of a ball or of a power series."""


def rectified(name):
    """ELU and ReLU, which have a kink and so take points, or balls on one side of it."""

    def function(z):
        if z >= 0:
            return z
        return z.exp() - 1 if name == "ELU" else arb(0)

    return function


def root_of(function):
    """A function of sqrt u, at u >= 0."""
    return lambda u: function(u.sqrt())


OF_A_SQUARE = {
    "inverse root": root_of(lambda r: 1 / r),
    "squash": root_of(lambda r: arb(1) if r == 0 else r.tanh() / r),
    "sech of root": root_of(lambda r: r.sech()),
    "inverse sinhc": root_of(lambda r: arb(1) if r == 0 else r / r.sinh()),
    "decay": lambda u: (-u).exp(),
}
"""A function of sqrt u, at u >= 0."""

SLOPES_OF_A_SQUARE = {
    "inverse root": root_of(lambda r: -1 / (2 * r**3)),
    "squash": root_of(lambda r: (r.sech() ** 2 - r.tanh() / r) / (2 * r**2)),
    "sech of root": root_of(lambda r: -r.sech() * r.tanh() / (2 * r)),
    "inverse sinhc": root_of(lambda r: (1 - r * r.coth()) / (2 * r * r.sinh())),
    "decay": lambda u: -(-u).exp(),
}
"""Its derivative, by u, at u > 0."""


def derivative(function, order, z):
    """The derivative of an order of a smooth function, over a ball z."""
    series = function(arb_series([z, 1], prec=order + 1))
    coefficients = series.coeffs()
    if len(coefficients) <= order:
        return arb(0)
    return coefficients[order] * arb(order).fac()


def divided(boxes, half):
    """The parts of squares of one size, of a half-side that halving leads to."""
    while boxes.half[0] > half:
        boxes = boxes.quarters()
    return boxes


def vector(values):
    return [arb(float(value)) for value in np.asarray(values)]


def dot(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), arb(0))


def mixture_at(mixture, z):
    """-log sum_i exp(-|z - x_i|^2 / 2 sigma^2), and its gradient."""
    variance = arb(mixture.sigma) ** 2
    offsets = [[a - b for a, b in zip(z, vector(x), strict=True)] for x in mixture.points]
    weights = [(-dot(y, y) / (2 * variance)).exp() for y in offsets]
    total = sum(weights, arb(0))
    means = [dot(weights, [y[k] for y in offsets]) / total for k in range(len(z))]
    return -total.log(), [mean / variance for mean in means]


def strands_at(strands, z, g):
    """The score and the tangent of directed strands."""
    variance = arb(strands.sigma) ** 2
    weights, offsets, pulls = [], [], []
    for point, T, one_way in zip(
        strands.points, strands.directions, strands.one_way, strict=True
    ):
        along = arb(ONE_WAY_SHARPNESS if one_way else TWO_WAY_SHARPNESS) * dot(vector(T), g)
        y = [a - b for a, b in zip(vector(point), z, strict=True)]
        factor = along.exp() if one_way else along.cosh()
        weights.append((-dot(y, y) / (2 * variance)).exp() * factor)
        offsets.append(y)
        pulls.append([x * (1 if one_way else along.tanh()) for x in vector(T)])
    total = sum(weights, arb(0))
    S, N = (
        [dot(weights, [row[k] for row in rows]) / total for k in range(len(z))]
        for rows in (offsets, pulls)
    )
    return [entry / variance for entry in S], N


def rested(composition, rest, z, S, N):
    """m at a point, with the rest at terminal ends, if there are any."""
    m = composed(composition, S, N)
    if rest is None:
        return m
    away = arb(1)
    for end in rest.ends:
        offset = [a - b for a, b in zip(z, vector(end), strict=True)]
        away = away * (1 - (-dot(offset, offset) / (2 * arb(rest.width) ** 2)).exp())
    at_rest = composed(rest.composition, S, N)
    return [a + (1 - away) * (b - a) for a, b in zip(m, at_rest, strict=True)]


def composed(composition, S, N):
    """m = s + v of a composition, by its formulas; of balls, or of power series."""
    gain = arb(composition.gain)
    if isinstance(composition, (PaperComposition, NormalisedComposition)):
        m = [s + v for s, v in zip(squashed(S, gain), N, strict=True)]
        return m if isinstance(composition, PaperComposition) else direction(m, UNIT_SOFTENING)
    v = direction(N, DIRECTION_SOFTENING)
    normal = projected(composition, S, v)
    share = composition.tangent_share * sech(gain * dot(normal, normal).sqrt())
    return [a + share * b for a, b in zip(squashed(normal, gain), v, strict=True)]


def projected(composition, S, v):
    """The score without its part along v near the path, if a composition asks for that."""
    if not composition.projects:
        return S
    ratio = (arb(composition.sigma) / PROJECTION_RANGE) ** 2 * dot(S, S)
    along = dot(S, v) / (1 + ratio ** (PROJECTION_POWER // 2))
    return [s - along * entry for s, entry in zip(S, v, strict=True)]


def unsquashed(composition, S, N):
    """m over what a composition multiplies everything by; of balls, or of power series."""
    if isinstance(composition, NormalisedComposition):
        return composed(PaperComposition(composition.gain), S, N)
    m = composed(composition, S, N)
    if isinstance(composition, PaperComposition):
        return m
    normal = projected(composition, S, direction(N, DIRECTION_SOFTENING))
    size = dot(normal, normal).sqrt()
    return [entry * size / FUNCTIONS["Tanh"](arb(composition.gain) * size) for entry in m]


def squashed(S, gain):
    square = dot(S, S)
    if isinstance(square, arb) and square == 0:
        return [arb(0) for _ in S]
    size = square.sqrt()
    factor = FUNCTIONS["Tanh"](gain * size) / size
    return [factor * s for s in S]


def direction(n, softening):
    size = (dot(n, n) + arb(softening) ** 2).sqrt()
    return [entry / size for entry in n]


def model_at(model, row, column, u):
    """The polynomial of a model at parameters u, and its remainder, as balls."""
    monomials = [arb(1), *vector(u)]
    monomials += [a * b for a, b in combinations_with_replacement(monomials[1:], 2)]
    polynomial = dot(vector(model.parts[row, :, column]), monomials)
    return polynomial, arb(float(model.remainder[row, column]))


def point_of(patches, u, row=0):
    """The point c + A u of a patch, as balls."""
    steps = [dot(vector(line), vector(u)) for line in patches.axes[row]]
    return [c + step for c, step in zip(vector(patches.centers[row]), steps, strict=True)]


def corners(k):
    """The corners, the middles of the sides, and so on, and the centre, (3^k, k)."""
    return np.array(list(product((-1.0, 0.0, 1.0), repeat=k)))


def random_patch(rng, half, dim, k, spread=4.0):
    """One patch of k parameters, turned at random, with sides of up to two half-sides."""
    turned = np.linalg.qr(rng.standard_normal((dim, dim)))[0][:, :k]
    axes = half * turned * rng.uniform(0.1, 1, k)
    return Patches(rng.uniform(-spread, spread, (1, dim)), axes[None])


def assert_inside(model, u, values):
    """Asserts that the models of the first patch hold values at parameters u."""
    for column, value in enumerate(values):
        polynomial, remainder = model_at(model, 0, column, u)
        assert abs(value - polynomial) <= remainder
        assert arb(float(model.lower[0, column])) <= value
        assert value <= arb(float(model.upper[0, column]))
