"""Fields and their derivatives in ball arithmetic, fast enough for many points.

The weights are matrices of balls, and what is carried through the layers are the units beside
their partial derivatives, so that one pass gives a network and its Jacobian.
"""

from dataclasses import dataclass

from flint import arb, arb_mat, arb_series
import numpy as np

from sgvf_drake.fields import GaussianMixture, HeldField, StrandMixture, StrandNetwork

from .balls import (
    FUNCTIONS,
    mixture_at,
    rectified,
    rested,
    sigmoid,
    strands_at,
    unsquashed,
    vector,
)


def matrix(array):
    return arb_mat([[arb(float(value)) for value in row] for row in np.atleast_2d(array)])


def dual(value, slope):
    """A function of one variable to first order, as a power series."""
    return arb_series([value, slope], prec=2)


class BallNetwork:
    """The outputs of a network of balls, each with its derivatives by d of the inputs."""

    def __init__(self, network, dim=2):
        self.dim = dim
        self.layers = [
            affine_of(weight, bias, dim)
            for weight, bias in zip(network.weights, network.biases, strict=True)
        ]
        self.activation = network.activation.name
        self.angles = None
        if network.features is not None:
            features = network.features
            self.angles = affine_of(features.frequencies, features.phases, dim)

    def __call__(self, z):
        """Returns [(value, slope, ...), ...] at a point, or over a square, of balls.

        Inputs after the first d are constant.
        """
        rows = [[x, *(arb(int(k == j)) for j in range(self.dim))] for k, x in enumerate(z)]
        if self.angles is not None:
            passed = self.angles[0].ncols()
            angles = applied(self.angles, rows[:passed])
            units = [unit for name in ("sine", "cosine") for unit in units_of(name, angles)]
            rows = units + rows[passed:]
        for layer in self.layers[:-1]:
            rows = units_of(self.activation, applied(layer, rows))
        return applied(self.layers[-1], rows)


def affine_of(weight, bias, dim):
    columns = np.column_stack([bias, np.zeros((len(bias), dim))])
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
        slopes: The derivatives of m by each coordinate.
        direction: A positive multiple of m; see `direction_model`.
        direction_slopes: The derivatives of that.
    """

    N: list
    S: list
    m: list
    slopes: list
    direction: list
    direction_slopes: list


class BallField:
    """A guiding field, or a directed one that is held, in normalised units."""

    def __init__(self, field):
        self.g = vector(field.g) if isinstance(field, HeldField) else None
        field = field.field if isinstance(field, HeldField) else field
        self.composition, self.rest, self.dim = field.composition, field.rest, field.dim
        if self.g is not None:
            self.strands = field.strands
            if isinstance(self.strands, StrandNetwork):
                self.network = BallNetwork(self.strands.network, self.dim)
            return
        self.tangent = BallNetwork(field.tangent_network, self.dim)
        score = field.score_model
        self.mixture = score if isinstance(score, GaussianMixture) else None
        if self.mixture is None:
            self.score = BallNetwork(score.network, self.dim)
            self.scale = arb(score.scale)

    def __call__(self, z):
        """Returns the values at a point of balls."""
        pairs = [self.score_and_tangent(z, k) for k in range(self.dim)]
        lines = [line_of(z, k) for k in range(self.dim)]
        fields = [
            rested(self.composition, self.rest, line, S, N)
            for line, (S, N) in zip(lines, pairs, strict=True)
        ]
        directions = fields
        if self.rest is None:
            directions = [unsquashed(self.composition, S, N) for S, N in pairs]
        N, S, m, direction = (
            [entry[0] for entry in part] for part in (*pairs[0][::-1], fields[0], directions[0])
        )
        slopes, others = (
            [[entry[1] for entry in field] for field in kind] for kind in (fields, directions)
        )
        return Values(N, S, m, slopes, direction, others)

    def score_and_tangent(self, z, k):
        """The raw score and the tangent along a coordinate, as power series."""
        if self.g is not None:
            return self.of_strands(z, k)
        N = along(self.tangent(z), k)
        if self.mixture is not None:
            return [-entry for entry in mixture_at(self.mixture, line_of(z, k))[1]], N
        return [entry / self.scale for entry in along(self.score([*z, arb(1)]), k)], N

    def of_strands(self, z, k):
        if isinstance(self.strands, StrandMixture):
            return strands_at(self.strands, line_of(z, k), self.g)
        output = along(self.network([*z, *self.g]), k)
        if self.strands.two_way:
            mirrored = along(self.network([*z, *(-x for x in self.g)]), k)
            signs = [1] * self.dim + [-1] * self.dim
            output = [
                (a + sign * b) / 2 for a, b, sign in zip(output, mirrored, signs, strict=True)
            ]
        sigma = arb(self.strands.sigma)
        return [entry / sigma for entry in output[: self.dim]], output[self.dim :]


def along(rows, k):
    """Values with their derivatives, as power series along a coordinate."""
    return [dual(row[0], row[1 + k]) for row in rows]


def line_of(z, k):
    """A point, as power series along a coordinate."""
    return [dual(value, int(k == j)) for j, value in enumerate(z)]
