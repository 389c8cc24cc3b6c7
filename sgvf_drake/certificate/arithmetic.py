"""What a machine's arithmetic makes of a field: bounds of its error over patches.

The exact m is the real function that the stored weights define.  A machine rounds positions,
weights and every operation, fl(a op b) = (a op b)(1 + d) with |d| <= u, sums of n products in
any order, and its elementary functions are off by a few u.  How far its m can be from the exact
one is bounded over whole patches, not at points:

- Every layer of a network makes an error of its own, from magnitudes over the patch.  That
  reaches the outputs through the exact rest of the network: by the mean value theorem, through
  signed products of the weights with slopes between the exact units and the computed ones.
  Slopes are bounded over the patch, widened by a first, crude bound of all errors (`_carried`).
- What errors of the score and of the tangent make of m is bounded by the partial derivatives of
  the composition over the patch, widened by these errors (`_partials`).
- The composition's own roundings are few, and are carried forward (`Rounded`).

Exports differ in the order of operations and in their formulas; what is assumed of each step is
generous enough for all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.certificate.expansions import COSINE, SINE, find_expansion
from sgvf_drake.certificate.field_model import TAYLOR, Algebra, PerturbedField, compose
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.kernels import UNIT as DOUBLE
from sgvf_drake.certificate.network_model import affine
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import (
    Differentiable,
    DualModel,
    Numbers,
    TaylorModel,
    Univariate,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import ComposedField, Perceptron, ScoreNetwork
from sgvf_drake.fields.composition import Composition

SINGLE = 2.0**-24
"""The unit roundoff of float32."""

STEPS = 16
"""Units of roundoff that an elementary function, or a formula of a few steps with one, is off
by at most: for activations, sines and cosines relative to one and the argument, for the others
to the value.  A cosine may be a sine a quarter turn ahead.  This is assumed, of four units or
fewer a call of the library; approximations of less accuracy are not covered."""

CHUNK = 512
"""Patches that are asked about at once."""

# A patch is halved while its bound is above what is enough, and so many times that at its
# middle, at most so often.
LOOSE, HALVINGS = 3.0, 8
# By such a part halves are longer.
OVERLAP = 2.0**-40


@dataclass(frozen=True)
class Arithmetic:
    """The numbers in which a field is evaluated.

    Attributes:
        unit: The unit roundoff u of operations and of positions.
        weights: The type of stored weights, and of what is computed of them beforehand.
        tiny: Above what underflow changes the result of an operation by.
    """

    unit: float
    weights: type[np.floating[Any]]
    tiny: float


_IN_DOUBLE = Arithmetic(DOUBLE, np.float64, 1e-290)
ARITHMETICS = {
    "double": _IN_DOUBLE,
    # It stores in float what that leaves exact, and computes in double.
    "mixed": _IN_DOUBLE,
    "float": Arithmetic(SINGLE, np.float32, 1e-37),
}
"""By the names that exports give them."""


@dataclass(frozen=True, eq=False)
class _Stage:
    """A layer and its units, as the errors of what is before go through it.

    Attributes:
        weight: (units, inputs).
        before: (n, units) the error that the products and sums make.
        slope: (n, units) of each unit, the middle of its bounds.
        spread: (n, units) how far the slope can be from that.
        after: (n, units) the error that the activation makes.
    """

    weight: FloatArray
    before: FloatArray
    slope: FloatArray
    spread: FloatArray
    after: FloatArray


@dataclass(frozen=True, eq=False)
class Layer:
    """Weights and biases, and how far those that a machine stores are from them.

    Attributes:
        weight: (outputs, inputs).
        bias: (outputs,).
        weight_off: (outputs, inputs).
        bias_off: (outputs,).
    """

    weight: FloatArray
    bias: FloatArray
    weight_off: FloatArray
    bias_off: FloatArray


def layers_of(network: Perceptron, arithmetic: Arithmetic, *, timed: bool) -> list[Layer]:
    """Returns the layers of a network, first that of its features, if it has some.

    Args:
        network: The network.
        arithmetic: That of the machine.
        timed: Whether its last input is the time, which is held at the data end.
    """

    def held(one: Perceptron) -> Perceptron:
        return one.with_last_input(1.0) if timed else one

    def stored(array: FloatArray) -> FloatArray:
        return array.astype(arithmetic.weights).astype(np.float64)

    exact = held(network)
    # What the time adds to biases is rounded, relative to the sum of sizes.
    sizes = held(_each(np.abs, network))
    layers = []
    for own, other, size in zip(
        *map(_pairs, (exact, _each(stored, exact), sizes)), strict=True
    ):
        offs = (
            np.abs(a - b) + 2 * DOUBLE * c + arithmetic.tiny
            for a, b, c in zip(own, other, size, strict=True)
        )
        layers.append(Layer(*own, *offs))
    return layers


def _each(change: Callable[[FloatArray], FloatArray], network: Perceptron) -> Perceptron:
    features = network.features
    if features is not None:
        features = replace(
            features, frequencies=change(features.frequencies), phases=change(features.phases)
        )
    weights, biases = (tuple(map(change, some)) for some in (network.weights, network.biases))
    return replace(network, weights=weights, biases=biases, features=features)


def _pairs(network: Perceptron) -> list[tuple[FloatArray, FloatArray]]:
    """Returns weights and biases of all layers; those of features for sines and cosines."""
    pairs = list(zip(network.weights, network.biases, strict=True))
    if network.features is None:
        return pairs
    waves = (np.tile(network.features.frequencies, (2, 1)), np.tile(network.features.phases, 2))
    return [waves, *pairs]


def network_error(
    network: Perceptron,
    patches: Patches,
    entry: FloatArray,
    arithmetic: Arithmetic,
    *,
    timed: bool = False,
) -> FloatArray:
    """Returns how far the outputs of a network can be from the exact ones, (n, outputs).

    Args:
        network: Of the position, or of the position and the time.
        patches: Where the position is.
        entry: (n, d) how far the machine's position can be from it.
        arithmetic: That of the machine.
        timed: Whether its last input is the time, which is held at the data end.
    """
    units, error, stages = TaylorModel.position(patches), entry, []
    *layers, last = layers_of(network, arithmetic, timed=timed)
    activation = (find_expansion(network.activation.name),)
    for number, layer in enumerate(layers):
        waves = number == 0 and network.features is not None
        functions = (SINE, COSINE) if waves else activation
        units, error, stage = _pass(units, error, layer, functions, arithmetic)
        stages.append(stage)
    own = _of_sums(units.magnitude + error, last, arithmetic)
    return own + _carried(last.weight, stages, entry)


def _pass(
    units: TaylorModel,
    error: FloatArray,
    layer: Layer,
    functions: Sequence[Univariate],
    arithmetic: Arithmetic,
) -> tuple[TaylorModel, FloatArray, _Stage]:
    """Returns the units of the next layer, a crude bound of their error, and its stage.

    Args:
        units: The exact units before it.
        error: (n, inputs) a bound of all errors until there.
        layer: The weights and the biases.
        functions: What follows, each for as many units as the others.
        arithmetic: That of the machine.
    """
    before = _of_sums(units.magnitude + error, layer, arithmetic)
    sums, _ = affine(units, layer.weight, layer.bias)
    error = (1 + SLACK * error.shape[1]) * (error @ np.abs(layer.weight).T) + before
    width = len(layer.bias) // len(functions)
    models, slopes, spreads = [], [], []
    for k, function in enumerate(functions):
        columns = slice(k * width, (k + 1) * width)
        own = sums.functions(columns)
        models.append(own.apply(function))
        slope, spread = _slopes(function, own, error[:, columns])
        slopes.append(slope)
        spreads.append(spread)
    slope, spread = np.concatenate(slopes, axis=1), np.concatenate(spreads, axis=1)
    after = STEPS * arithmetic.unit * (1 + sums.magnitude + error) + arithmetic.tiny
    stage = _Stage(layer.weight, before, slope, spread, after)
    error = (1 + SLACK) * (np.abs(slope) + spread) * error + after
    first, *others = models
    return first.joined(*others), error, stage


def _of_sums(size: FloatArray, layer: Layer, arithmetic: Arithmetic) -> FloatArray:
    """Returns the error (n, outputs) of weight units + bias, of units of sizes (n, inputs).

    Of stored weights, and of their products and sums in any order.
    """
    inputs = layer.weight.shape[1]
    # One each for the bias, a factor that the layer may be scaled by, and its rounding.
    gamma = 1.01 * (inputs + 3) * arithmetic.unit
    entries = layer.weight_off + gamma * (np.abs(layer.weight) + layer.weight_off)
    offset = layer.bias_off + gamma * (np.abs(layer.bias) + layer.bias_off)
    total = (1 + SLACK * inputs) * (size @ entries.T) + offset + inputs * arithmetic.tiny
    return np.asarray(total)


def _slopes(
    function: Univariate, sums: TaylorModel, error: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns the middle slopes of units between exact and computed sums, and their spread."""
    low, high, about = sums.lower - error, sums.upper + error, sums.value
    if not isinstance(function, Differentiable):
        # A rectifier's slope is zero or one.
        slope = np.where(low > 0, 1.0, np.where(high < 0, 0.0, 0.5))
        return slope, np.where((low <= 0) & (high >= 0), 0.5, 0.0)
    found = function.expand_slope(about, low, high)
    reach = np.maximum(high - about, about - low)
    spread = np.abs(found.slope) * reach + np.abs(found.curvature) / 2 * reach**2 + found.rest
    return found.value, (1 + SLACK) * spread


def _carried(last: FloatArray, stages: Sequence[_Stage], entry: FloatArray) -> FloatArray:
    """Returns what the errors of all stages make of the outputs, at most, (n, outputs).

    `through` is the product of weights and middle slopes behind a stage, and `around` bounds
    how far the product with the slopes themselves can be from it.
    """
    through = np.broadcast_to(last, (len(entry), *last.shape))
    around = SLACK * np.abs(through)
    total = np.zeros((len(entry), len(last)))
    for stage in reversed(stages):
        total += np.einsum("nok,nk->no", np.abs(through) + around, stage.after)
        slope, spread = stage.slope[:, None], stage.spread[:, None]
        around = np.abs(through) * spread + around * (np.abs(slope) + spread)
        through = through * slope
        reached = np.abs(through) + around
        total += np.einsum("nok,nk->no", reached, stage.before)
        n, outputs, width = through.shape
        size = np.abs(stage.weight)
        # With what rounding changes of these products, by far.
        rounding = SLACK * width * np.abs(through)
        around = ((around + rounding).reshape(-1, width) @ size).reshape(n, outputs, -1)
        through = (through.reshape(-1, width) @ stage.weight).reshape(n, outputs, -1)
        around = (1 + SLACK * width) * around
    total += np.einsum("nok,nk->no", np.abs(through) + around, entry)
    return np.asarray(total * (1 + SLACK * (1 + len(stages))))


@dataclass(frozen=True, eq=False)
class Rounded:
    """Exact functions over patches, and how far a machine's are from them.

    It has the operations of a `TaylorModel` that a composition asks for.

    Attributes:
        exact: The functions.
        error: (n, f).
        arithmetic: That of the machine.
    """

    exact: TaylorModel
    error: FloatArray
    arithmetic: Arithmetic

    def __add__(self, other: "Rounded") -> "Rounded":
        return self._rounded(self.exact + other.exact, self.error + other.error)

    def __sub__(self, other: "Rounded") -> "Rounded":
        return self + other.scaled(-1.0)

    def __mul__(self, other: "Rounded") -> "Rounded":
        a, b = self.exact.magnitude, other.exact.magnitude
        error = a * other.error + b * self.error + self.error * other.error
        return self._rounded(self.exact * other.exact, error)

    def scaled(self, factor: Numbers) -> "Rounded":
        """Returns the functions times numbers."""
        return self._rounded(self.exact.scaled(factor), np.abs(factor) * self.error)

    def shifted(self, offset: Numbers) -> "Rounded":
        """Returns the functions plus numbers."""
        stored = 2 * self.arithmetic.unit * np.abs(offset)
        return self._rounded(self.exact.shifted(offset), self.error + stored)

    def dot(self, other: "Rounded") -> "Rounded":
        """Returns the sum of the products of the functions."""
        products = self * other
        size = (products.exact.magnitude + products.error).sum(axis=1, keepdims=True)
        error = products.error.sum(axis=1, keepdims=True)
        exact = self.exact.dot(other.exact)
        return self._rounded(exact, error + self.error.shape[1] * self.arithmetic.unit * size)

    def apply(self, function: Differentiable, *, least: float = -np.inf) -> "Rounded":
        """Returns a function of each; see `TaylorModel.apply`."""
        reached = replace(self.exact, remainder=self.exact.remainder + self.error)
        slope = reached.apply_slope(function, least=least).magnitude
        size = reached.apply(function, least=least).magnitude
        own = STEPS * self.arithmetic.unit * size
        exact = self.exact.apply(function, least=least)
        return self._rounded(exact, slope * self.error + own)

    def _rounded(self, exact: TaylorModel, error: FloatArray) -> "Rounded":
        # Of the result, and of a factor.
        unit = 2.01 * self.arithmetic.unit
        error = (1 + unit + SLACK) * error + unit * exact.magnitude + self.arithmetic.tiny
        return Rounded(exact, error, self.arithmetic)


@dataclass(frozen=True, eq=False)
class ExportedField(PerturbedField):
    """A field as a machine evaluates it: m, and whatever is no further from it than its errors.

    Attributes:
        field: m, of networks of the position.
        arithmetic: That of the machine.
        enough: Bounds below it are not made any closer.
        largest: The largest error over all patches that were asked about.

    Raises:
        ConfigurationError: If nothing bounds the errors of such a field.
    """

    field: ComposedField
    arithmetic: Arithmetic
    enough: float = 1e-3
    largest: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.field, ComposedField):
            raise ConfigurationError("errors of directed fields are not bounded so far")
        if not isinstance(self.field.score_model, ScoreNetwork):
            raise ConfigurationError("errors of a closed-form score are not bounded so far")

    def error(self, patches: Patches) -> FloatArray:
        """Returns how far the machine's m can be from the exact one over patches, (n,).

        In the norm of R^d; where nothing is known, infinite.
        """
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = self._by_parts(patches, HALVINGS)
        found = np.where(np.isnan(found), np.inf, found)
        object.__setattr__(self, "largest", max(self.largest, found.max(initial=0.0)))
        return found

    def _by_parts(self, patches: Patches, halvings: int) -> FloatArray:
        """Returns the bounds, with patches halved where that makes them much smaller."""
        found = self._bound(patches)
        if halvings == 0 or patches.axes.shape[2] == 0:
            return found
        loose = np.flatnonzero(~(found <= self.enough))
        here = self._bound(Patches.points(patches.centers[loose]))
        loose = loose[~(found[loose] <= LOOSE * here)]
        if len(loose):
            parts = [self._by_parts(part, halvings - 1) for part in _halves(patches, loose)]
            found[loose] = np.max(parts, axis=0)
        return found

    def _bound(self, patches: Patches) -> FloatArray:
        starts = range(0, len(patches), CHUNK)
        parts = [self._bound_chunk(patches[start : start + CHUNK]) for start in starts]
        return np.concatenate([np.empty(0), *parts])

    def _bound_chunk(self, patches: Patches) -> FloatArray:
        field, arithmetic = self.field, self.arithmetic
        entry = self._of_position(patches)
        assert isinstance(field.score_model, ScoreNetwork)
        output = field.score_model.network
        S_error = network_error(output, patches, entry, arithmetic, timed=True)
        # With what the factor makes of it.
        S_error = (1 + 3 * arithmetic.unit + SLACK) * S_error / field.score_model.scale
        N_error = network_error(field.tangent_network, patches, entry, arithmetic)
        S, N = TAYLOR.score_and_tangent(field, patches)
        S, N = _widened(S, S_error), _widened(N, N_error)
        compositions = [field.composition]
        if field.rest is not None:
            compositions.append(field.rest.composition)
        partials = np.max([_partials(one, S, N) for one in compositions], axis=0)
        carried = np.einsum("nij,nj->ni", partials, np.hstack([S_error, N_error]))
        own = self._composed(S, N, patches, entry).error
        return np.linalg.norm((1 + SLACK) * (carried + own), axis=1) * (1 + SLACK)

    def _composed(
        self, S: TaylorModel, N: TaylorModel, patches: Patches, entry: FloatArray
    ) -> Rounded:
        """Returns m of a score and a tangent that are exact, of the machine's position."""

        def rounded(model: TaylorModel, error: FloatArray) -> Rounded:
            return Rounded(model, error, self.arithmetic)

        algebra: Algebra[Any] = Algebra(
            lambda where: rounded(TaylorModel.position(where), entry), _refused, _refused
        )
        nothing = np.zeros_like(entry)
        found: Rounded = algebra.composed(
            self.field, rounded(S, nothing), rounded(N, nothing), patches
        )
        return found

    def _of_position(self, patches: Patches) -> FloatArray:
        """Returns the error of the normalised position, (n, d): x, the centre, the quotient."""
        cloud, unit = self.field.cloud, self.arithmetic.unit
        z = TaylorModel.position(patches).magnitude
        return 4.1 * unit * (z + 2 * np.abs(cloud.center) / cloud.unit_length)


def _refused(*_: Any) -> Any:
    raise AssertionError("score and tangent are given")


def _widened(model: TaylorModel, error: FloatArray) -> TaylorModel:
    """Returns models that hold all that is no further from the functions than an error."""
    return replace(model, remainder=(1 + SLACK) * (model.remainder + error))


def _partials(composition: Composition, S: TaylorModel, N: TaylorModel) -> FloatArray:
    """Returns bounds of |dm_i/dS_j| and |dm_i/dN_j| over patches, (n, d, 2d)."""
    d = S.value.shape[1]
    units = np.eye(d, 3 * d, d)
    slopes = []
    for first in (d, 0):
        models = []
        for column in units[:, first : first + 2 * d].T:
            parts = np.zeros_like(S.parts)
            parts[:, 0] = column
            models.append(TaylorModel(parts, np.zeros_like(S.remainder)))
        slopes.append(tuple(models))
    m = compose(composition, DualModel(S, slopes[0]), DualModel(N, slopes[1]))
    return np.stack([slope.magnitude for slope in m.slopes], axis=2)


def _halves(patches: Patches, rows: IntArray) -> list[Patches]:
    """Returns both halves of some patches, along the longest axis of each.

    The centres are exact where the numbers of the patches are those of a dyadic grid, as those
    of certificates are; of others the halves are a little longer.
    """
    centers, axes = patches.centers[rows], patches.axes[rows].copy()
    longest = np.linalg.norm(axes, axis=1).argmax(axis=1)
    across = np.arange(len(rows)), slice(None), longest
    axes[across] /= 2
    longer = (1 + OVERLAP) * axes
    return [Patches(centers + side * axes[across], longer) for side in (-1.0, 1.0)]
