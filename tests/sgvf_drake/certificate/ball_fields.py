"""Fields and their derivatives in ball arithmetic, fast enough for many points.

The weights are matrices of balls, and what is carried through the layers are the units beside
their two partial derivatives, so that one pass gives a network and its Jacobian.
"""

from dataclasses import dataclass

from flint import arb, arb_mat, arb_series
import numpy as np

from sgvf_drake.fields import GaussianMixture

from .balls import FUNCTIONS, composed, mixture_at, rectified, sigmoid


def matrix(array):
    return arb_mat([[arb(float(value)) for value in row] for row in np.atleast_2d(array)])


def dual(value, slope):
    """A function of one variable to first order, as a power series."""
    return arb_series([value, slope], prec=2)


class BallNetwork:
    """The outputs of a network of balls, each with its two partial derivatives."""

    def __init__(self, network):
        self.layers = [
            affine_of(weight, bias)
            for weight, bias in zip(network.weights, network.biases, strict=True)
        ]
        self.activation = network.activation.name
        self.angles = None
        if network.features is not None:
            self.angles = affine_of(network.features.frequencies, network.features.phases)

    def __call__(self, z):
        """Returns [(value, slope, slope), ...] at a point, or over a square, of balls.

        Inputs after the first two are constant.
        """
        rows = [[x, *(arb(int(k == j)) for j in range(2))] for k, x in enumerate(z)]
        if self.angles is not None:
            angles = applied(self.angles, rows)
            rows = [unit for name in ("sine", "cosine") for unit in units_of(name, angles)]
        for layer in self.layers[:-1]:
            rows = units_of(self.activation, applied(layer, rows))
        return applied(self.layers[-1], rows)


def affine_of(weight, bias):
    columns = np.column_stack([bias, np.zeros((len(bias), 2))])
    return matrix(weight), matrix(columns)


def applied(affine, rows):
    weight, bias = affine
    return (weight * arb_mat(rows) + bias).tolist()


def units_of(name, rows):
    """The values of a function, and its derivatives by the chain rule."""
    function, units = WITH_SLOPE.get(name), []
    for value, *slopes in rows:
        found = function(value) if function else FUNCTIONS[name](dual(value, 1))
        units.append([found[0], *(found[1] * inner for inner in slopes)])
    return units


def silu_with_slope(u):
    gate = sigmoid(u)
    return u * gate, gate + u * gate * (1 - gate)


def tanh_with_slope(u):
    value = 2 * sigmoid(2 * u) - 1
    return value, 1 - value**2


def rectified_with_slope(name):
    """ELU and ReLU at a point; either slope serves where there is a kink."""

    def function(u):
        value = rectified(name)(u)
        return value, arb(1) if u >= 0 else value + 1 if name == "ELU" else arb(0)

    return function


WITH_SLOPE = {
    "SiLU": silu_with_slope,
    "Tanh": tanh_with_slope,
    "ELU": rectified_with_slope("ELU"),
    "ReLU": rectified_with_slope("ReLU"),
}
"""Of the first two in forms that are narrower over wide balls than power series are."""


@dataclass(frozen=True)
class Values:
    """What a field is made of at a point, of balls.

    Attributes:
        N: Outputs of the tangent network.
        S: The raw score.
        m: The field.
        slopes: The derivatives of m by either coordinate.
    """

    N: list
    S: list
    m: list
    slopes: list


class BallField:
    """A guiding field, in normalised units."""

    def __init__(self, field):
        self.composition = field.composition
        self.tangent = BallNetwork(field.tangent_network)
        score = field.score_model
        self.mixture = score if isinstance(score, GaussianMixture) else None
        if self.mixture is None:
            self.score = BallNetwork(score.network)
            self.scale = arb(score.scale)

    def __call__(self, z):
        """Returns the values at a point of balls."""
        tangent = directions(self.tangent(z))
        score = self.raw_score(z)
        fields = [composed(self.composition, S, N) for S, N in zip(score, tangent, strict=True)]
        N, S, m = ([entry[0] for entry in part[0]] for part in (tangent, score, fields))
        return Values(N, S, m, [[entry[1] for entry in field] for field in fields])

    def raw_score(self, z):
        """The raw score along either coordinate, as power series."""
        if self.mixture is None:
            rows = self.score([*z, arb(1)])
            return [[entry / self.scale for entry in part] for part in directions(rows)]
        lines = [[dual(value, int(k == j)) for j, value in enumerate(z)] for k in range(2)]
        return [[-entry for entry in mixture_at(self.mixture, line)[1]] for line in lines]


def directions(rows):
    """Values with their two derivatives, as power series along either coordinate."""
    return [[dual(row[0], row[1 + k]) for row in rows] for k in range(2)]
