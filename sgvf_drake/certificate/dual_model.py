"""Functions over squares with their derivatives: dual numbers whose parts are Taylor models."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import COSINE, SINE, find_expansion
from sgvf_drake.certificate.network_model import affine
from sgvf_drake.certificate.taylor_model import Differentiable, TaylorModel, concatenate
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.perceptron import Perceptron


@dataclass(frozen=True, eq=False)
class DualModel:
    """Models of k functions and of their two partial derivatives, over each of n squares.

    It has the operations of a `TaylorModel` that a composition asks for.

    Attributes:
        value: Of the functions.
        slopes: Of their derivatives by each coordinate.
    """

    value: TaylorModel
    slopes: tuple[TaylorModel, TaylorModel]

    @classmethod
    def position(cls, boxes: Boxes) -> "DualModel":
        """Returns the models of the two coordinates."""
        value = TaylorModel.position(boxes)
        first, second = (
            TaylorModel.constant(boxes.half, np.broadcast_to(unit, (len(boxes), 2)))
            for unit in np.eye(2)
        )
        return cls(value, (first, second))

    @property
    def divergence(self) -> TaylorModel:
        """The model (n, 1) of the divergence of two functions."""
        along = np.zeros_like(self.value.value)
        first, second = along.copy(), along.copy()
        first[:, 0], second[:, 1] = 1.0, 1.0
        return self.slopes[0].weighted(first) + self.slopes[1].weighted(second)

    def __add__(self, other: "DualModel") -> "DualModel":
        a, b = self.slopes, other.slopes
        return DualModel(self.value + other.value, (a[0] + b[0], a[1] + b[1]))

    def __sub__(self, other: "DualModel") -> "DualModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: float) -> "DualModel":
        """Returns the functions times a number."""
        first, second = self.slopes
        return DualModel(
            self.value.scaled(factor), (first.scaled(factor), second.scaled(factor))
        )

    def shifted(self, offset: float) -> "DualModel":
        """Returns the functions plus a number."""
        return DualModel(self.value.shifted(offset), self.slopes)

    def __mul__(self, other: "DualModel") -> "DualModel":
        a, b = self.value, other.value
        first, second = (
            mine * b + a * theirs
            for mine, theirs in zip(self.slopes, other.slopes, strict=True)
        )
        return DualModel(a * b, (first, second))

    def dot(self, other: "DualModel") -> "DualModel":
        """Returns the sum of the products of the functions."""
        a, b = self.value, other.value
        first, second = (
            mine.dot(b) + a.dot(theirs)
            for mine, theirs in zip(self.slopes, other.slopes, strict=True)
        )
        return DualModel(a.dot(b), (first, second))

    def apply(self, function: Differentiable, *, least: float = -np.inf) -> "DualModel":
        """Returns a function of each; see `TaylorModel.apply`."""
        slope = self.value.apply_slope(function, least=least)
        first, second = self.slopes
        return DualModel(
            self.value.apply(function, least=least), (slope * first, slope * second)
        )


def dual_network(network: Perceptron, boxes: Boxes) -> DualModel:
    """Returns the outputs of a network of two inputs, and their derivatives.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no derivative.
    """
    units = DualModel.position(boxes)
    if network.features is not None:
        angles = _affine(units, network.features.frequencies, network.features.phases)
        units = _concatenate(angles.apply(SINE), angles.apply(COSINE))
    activation = find_expansion(network.activation.name)
    if not isinstance(activation, Differentiable):
        raise ConfigurationError(f"{network.activation.name} has no derivative everywhere")
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units = _affine(units, weight, bias).apply(activation)
    return _affine(units, network.weights[-1], network.biases[-1])


def _affine(units: DualModel, weight: FloatArray, bias: FloatArray) -> DualModel:
    nothing = np.zeros_like(bias)
    first, second = (affine(slope, weight, nothing)[0] for slope in units.slopes)
    return DualModel(affine(units.value, weight, bias)[0], (first, second))


def _concatenate(a: DualModel, b: DualModel) -> DualModel:
    first, second = (
        concatenate([mine, theirs]) for mine, theirs in zip(a.slopes, b.slopes, strict=True)
    )
    return DualModel(concatenate([a.value, b.value]), (first, second))
