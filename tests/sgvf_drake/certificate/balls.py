"""Ball arithmetic (Arb, by python-flint): what the models are held against.

A float64 becomes the ball of itself, and every result holds the true value.
"""

from flint import arb, arb_series, ctx
import numpy as np

from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_POWER,
    PROJECTION_RANGE,
    UNIT_SOFTENING,
    NormalisedComposition,
    PaperComposition,
)

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
}
"""A function of sqrt u, at u >= 0."""

SLOPES_OF_A_SQUARE = {
    "inverse root": root_of(lambda r: -1 / (2 * r**3)),
    "squash": root_of(lambda r: (r.sech() ** 2 - r.tanh() / r) / (2 * r**2)),
    "sech of root": root_of(lambda r: -r.sech() * r.tanh() / (2 * r)),
    "inverse sinhc": root_of(lambda r: (1 - r * r.coth()) / (2 * r * r.sinh())),
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


def composed(composition, S, N):
    """m = s + v of a composition, by its formulas; of balls, or of power series."""
    gain = arb(composition.gain)
    if isinstance(composition, (PaperComposition, NormalisedComposition)):
        m = [s + v for s, v in zip(squashed(S, gain), N, strict=True)]
        return m if isinstance(composition, PaperComposition) else direction(m, UNIT_SOFTENING)
    v = direction(N, DIRECTION_SOFTENING)
    normal = S
    if composition.projects:
        ratio = (arb(composition.sigma) / PROJECTION_RANGE) ** 2 * dot(S, S)
        along = dot(S, v) / (1 + ratio ** (PROJECTION_POWER // 2))
        normal = [s - along * entry for s, entry in zip(S, v, strict=True)]
    share = composition.tangent_share * sech(gain * dot(normal, normal).sqrt())
    return [a + share * b for a, b in zip(squashed(normal, gain), v, strict=True)]


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


def model_at(model, row, column, d):
    """The polynomial of a model at a step d, and its remainder, as balls."""
    x, y = vector(d)
    J, q = vector(model.jacobian[row, :, column]), vector(model.quadratic[row, :, column])
    value = arb(float(model.value[row, column]))
    polynomial = value + J[0] * x + J[1] * y + q[0] * x * x + q[1] * x * y + q[2] * y * y
    return polynomial, arb(float(model.remainder[row, column]))


def point_of(boxes, d):
    """The point of the first square at a step d from its centre, as balls."""
    return [arb(float(c)) + arb(float(x)) for c, x in zip(boxes.centers[0], d, strict=True)]


def assert_inside(model, d, values):
    """Asserts that the models of the first square hold values at a step d."""
    for column, value in enumerate(values):
        polynomial, remainder = model_at(model, 0, column, d)
        assert abs(value - polynomial) <= remainder
        assert arb(float(model.lower[0, column])) <= value
        assert value <= arb(float(model.upper[0, column]))
