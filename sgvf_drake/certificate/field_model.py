"""Guiding fields over patches: models of m from those of its score and its tangent."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from operator import mul
from typing import Generic

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import (
    DECAY,
    FALL,
    INVERSE_ROOT,
    INVERSE_SINHC,
    SECH_OF_ROOT,
    SQUASH,
    find_expansion,
)
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import Components
from sgvf_drake.certificate.network_model import dual_network, model_network
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import Differentiable, DualModel, Model, TaylorModel
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    ComposedField,
    DirectedField,
    GaussianMixture,
    HeldField,
    NormalisedComposition,
    PaperComposition,
    Perceptron,
    RobustComposition,
    ScoreInducedField,
    ScoreNetwork,
    StrandMixture,
    StrandNetwork,
)
from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_POWER,
    PROJECTION_RANGE,
    UNIT_SOFTENING,
    Composition,
)
from sgvf_drake.fields.rest import Rest

assert PROJECTION_POWER == 8, "FALL is not the projection's power of |S|^2"

ExactField = ComposedField | HeldField
"""The fields of the position alone that are bounded; of directed ones those at a constant g."""


@dataclass(frozen=True, eq=False)
class PerturbedField(ABC):
    """All functions that are no further from a field than an error, as one field.

    What is proved of it holds for each of them.  Its derivatives are those of the field.

    Attributes:
        field: m.
    """

    field: ComposedField

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return self.field.dim

    @property
    def cloud(self) -> PointCloud:
        """The waypoints."""
        return self.field.cloud

    @abstractmethod
    def error(self, patches: Patches) -> FloatArray:
        """Returns how far a function can be from m over patches, in the norm of R^d, (n,)."""


BoundedField = ExactField | PerturbedField


@dataclass(frozen=True)
class Algebra(Generic[Model]):
    """What fields are composed of, in one kind of model: with derivatives, or without.

    Attributes:
        position: The coordinates, over patches.
        network: The outputs of a network, with the values of the inputs after the position.
        components: The score and the pulls of a mixture.
    """

    position: Callable[[Patches], Model]
    network: Callable[[Perceptron, Patches, tuple[float, ...]], Model]
    components: Callable[[Components, Patches], Model]

    def field(self, field: ExactField, patches: Patches) -> Model:
        """Returns the models of m."""
        S, N = self.score_and_tangent(field, patches)
        return self.composed(
            field.field if isinstance(field, HeldField) else field, S, N, patches
        )

    def composed(self, field: ScoreInducedField, S: Model, N: Model, patches: Patches) -> Model:
        """Returns the models of m, of those of the raw score and of the tangent."""
        m, rest = compose(field.composition, S, N), field.rest
        if rest is None:
            return m
        away = self._away(rest, patches)
        # Not as m + near (at_rest - m), which would count the remainder of m twice.
        return away * m + _one_less(away) * compose(rest.composition, S, N)

    def direction(self, field: ExactField, patches: Patches) -> Model:
        """Returns the models of m times a positive function; where paths end, m itself."""
        base = field.field if isinstance(field, HeldField) else field
        if base.rest is not None:
            return self.field(field, patches)
        return simplify(base.composition, *self.score_and_tangent(field, patches))

    def score_and_tangent(self, field: ExactField, patches: Patches) -> tuple[Model, Model]:
        """Returns the models of the raw score S and of the tangent N as it comes."""
        match field:
            case ComposedField():
                N = self.network(field.tangent_network, patches, ())
                return self.score(field.score_model, patches), N
            case HeldField() if field.g.ndim == 1:
                both, d = self._strands(field, patches), field.dim
                return both.functions(slice(d)), both.functions(slice(d, None))
        raise ConfigurationError(
            f"nothing bounds a {type(field).__name__}: of guiding fields those of the position "
            "alone are bounded, and directed ones that are held at one intended direction"
        )

    def score(self, score: ScoreNetwork | GaussianMixture, patches: Patches) -> Model:
        """Returns the models of the raw score S."""
        if isinstance(score, GaussianMixture):
            return self.components(Components.of(score), patches)
        return self.network(score.network, patches, (1.0,)).scaled(1 / score.scale)

    def _strands(self, field: HeldField, patches: Patches) -> Model:
        """Returns the models (n, 2d) of S and N of directed strands."""
        strands, g = field.field.strands, field.g
        if isinstance(strands, StrandMixture):
            return self.components(Components.heading(strands, g), patches)
        factors = np.repeat([1 / strands.sigma, 1.0], field.dim)
        output = self.network(strands.network, patches, tuple(g))
        if strands.two_way:
            # The even part of the score, and the odd one of the tangent.
            mirrored = self.network(strands.network, patches, tuple(-g))
            output = output + mirrored.scaled(np.repeat([1.0, -1.0], field.dim))
            factors = factors / 2
        return output.scaled(factors)

    def _away(self, rest: Rest, patches: Patches) -> Model:
        """Returns the model (n, 1) of how far from the ends it is, 1 less `Rest.weight`."""
        offsets = [self.position(patches).shifted(-end) for end in rest.ends]
        factor = 1 / (2 * rest.width**2)
        bumps = [x.dot(x).scaled(factor).apply(DECAY, least=0.0) for x in offsets]
        return reduce(mul, map(_one_less, bumps))


def _one_less(model: Model) -> Model:
    return model.scaled(-1.0).shifted(1.0)


TAYLOR = Algebra(TaylorModel.position, model_network, Components.model)
DUAL = Algebra(DualModel.position, dual_network, Components.dual)


def model_field(field: BoundedField, patches: Patches) -> TaylorModel:
    """Returns the models of m, (n, d), over patches in the field's normalised units.

    Raises:
        ConfigurationError: The field is of a kind that nothing here bounds.
    """
    if isinstance(field, PerturbedField):
        return _perturbed(TAYLOR.field(field.field, patches), field.error(patches))
    return TAYLOR.field(field, patches)


def direction_model(field: BoundedField, patches: Patches) -> TaylorModel:
    """Returns the models of m times a positive function, which are tighter; see `simplify`.

    Raises:
        ConfigurationError: The field is of a kind that nothing here bounds.
    """
    if not isinstance(field, PerturbedField):
        return TAYLOR.direction(field, patches)
    exact = field.field
    if exact.rest is not None:
        return model_field(field, patches)
    S, N = TAYLOR.score_and_tangent(exact, patches)
    error = _largest_factor(exact.composition, S, N) * field.error(patches)
    return _perturbed(simplify(exact.composition, S, N), error)


def direction_dual(field: BoundedField, patches: Patches) -> DualModel:
    """Returns the models of m times a positive function, and of its derivatives.

    Raises:
        ConfigurationError: The field is of a kind whose derivatives nothing here bounds.
    """
    return DUAL.direction(_exact(field), patches)


def dual_field(field: BoundedField, patches: Patches) -> DualModel:
    """Returns the models of m and of its derivatives, by normalised units of length.

    Raises:
        ConfigurationError: The field is of a kind whose derivatives nothing here bounds.
    """
    return DUAL.field(_exact(field), patches)


def has_dual(field: BoundedField) -> bool:
    """Whether `dual_field` bounds the derivatives of a field: its activations are smooth."""
    return all(
        isinstance(find_expansion(network.activation.name), Differentiable)
        for network in _networks(_exact(field))
    )


def largest_error(field: BoundedField, patches: Patches) -> float:
    """Returns how far from m functions can be that are meant with a field, over patches."""
    return float(field.error(patches).max()) if isinstance(field, PerturbedField) else 0.0


def _perturbed(model: TaylorModel, error: FloatArray) -> TaylorModel:
    """Returns models of all functions that are no further from these than an error (n,)."""
    return replace(model, remainder=(1 + SLACK) * (model.remainder + error[:, None]))


def _exact(field: BoundedField) -> ExactField:
    return field.field if isinstance(field, PerturbedField) else field


def _networks(field: ExactField) -> list[Perceptron]:
    match field:
        case HeldField(field=DirectedField(strands=StrandNetwork(network=network))):
            return [network]
        case ComposedField(score_model=ScoreNetwork(network=network)):
            return [network, field.tangent_network]
        case ComposedField():
            return [field.tangent_network]
    return []


def compose(composition: Composition, S: Model, N: Model) -> Model:
    """Returns the models of m = s + v by a composition; see `Composition.value`."""
    match composition:
        case PaperComposition(gain=gain):
            return _squashed(S, gain) + N
        case NormalisedComposition(gain=gain):
            return _direction(_squashed(S, gain) + N, UNIT_SOFTENING)
        case RobustComposition():
            return _robust(composition, S, N)
    raise ConfigurationError(f"nothing bounds a {type(composition).__name__}")


def simplify(composition: Composition, S: Model, N: Model) -> Model:
    """Returns the models of m times a positive function: of the same zeros, of the same kinds.

    In those of a robust field the score is not squashed.  tanh makes it a direction alone where
    it is large, which turns around at once where it comes near zero.
    """
    match composition:
        case NormalisedComposition(gain=gain):
            return compose(PaperComposition(gain), S, N)
        case RobustComposition(gain=gain) if gain > 0:
            v = _direction(N, DIRECTION_SOFTENING)
            normal = _normal(composition, S, v)
            # sech over tanh(k r) / r.
            ratio = normal.dot(normal).scaled(gain**2).apply(INVERSE_SINHC, least=0.0)
            return normal + ratio.scaled(composition.tangent_share / gain) * v
    return compose(composition, S, N)


def _largest_factor(composition: Composition, S: TaylorModel, N: TaylorModel) -> FloatArray:
    """Returns what `simplify` multiplies m by over patches, at most, (n,)."""
    match composition:
        case NormalisedComposition(gain=gain):
            n = _squashed(S, gain) + N
            largest = np.sqrt(n.dot(n).shifted(UNIT_SOFTENING**2).upper[:, 0])
        case RobustComposition(gain=gain) if gain > 0:
            normal = _normal(composition, S, _direction(N, DIRECTION_SOFTENING))
            squash = normal.dot(normal).scaled(gain**2).apply(SQUASH, least=0.0).lower[:, 0]
            largest = np.where(squash > 0, 1 / (gain * squash), np.inf)
        case _:
            largest = np.ones(len(S.parts))
    return np.asarray((1 + SLACK) * largest)


def _robust(composition: RobustComposition, S: Model, N: Model) -> Model:
    v = _direction(N, DIRECTION_SOFTENING)
    normal = _normal(composition, S, v)
    square = normal.dot(normal).scaled(composition.gain**2)
    a = square.apply(SQUASH, least=0.0).scaled(composition.gain)
    b = square.apply(SECH_OF_ROOT, least=0.0).scaled(composition.tangent_share)
    return a * normal + b * v


def _normal(composition: RobustComposition, S: Model, v: Model) -> Model:
    """S', the score without its part along the tangent near the path."""
    if not composition.projects:
        return S
    scale = (composition.sigma / PROJECTION_RANGE) ** 2
    g = S.dot(S).scaled(scale).apply(FALL, least=0.0)
    return S - (g * S.dot(v)) * v


def _squashed(S: Model, gain: float) -> Model:
    """tanh(k |S|) S / |S|."""
    factor = S.dot(S).scaled(gain**2).apply(SQUASH, least=0.0)
    return factor.scaled(gain) * S


def _direction(n: Model, softening: float) -> Model:
    """N / sqrt(|n|^2 + softening^2)."""
    square = n.dot(n).shifted(softening**2)
    return square.apply(INVERSE_ROOT, least=softening**2) * n
