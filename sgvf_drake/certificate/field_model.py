"""Guiding fields over squares: models of m from those of its score and its tangent network."""

from typing import TypeVar

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import (
    FALL,
    INVERSE_ROOT,
    INVERSE_SINHC,
    SECH_OF_ROOT,
    SQUASH,
    find_expansion,
)
from sgvf_drake.certificate.mixture_model import MixtureModel, dual_mixture
from sgvf_drake.certificate.network_model import dual_network, model_network
from sgvf_drake.certificate.taylor_model import Differentiable, DualModel, TaylorModel
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    GaussianMixture,
    GuidingField,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_POWER,
    PROJECTION_RANGE,
    UNIT_SOFTENING,
    Composition,
)

assert PROJECTION_POWER == 8, "FALL is not the projection's power of |S|^2"


def model_field(field: GuidingField, boxes: Boxes) -> TaylorModel:
    """Returns the models of m, (n, 2), over squares in the field's normalised units.

    Raises:
        ConfigurationError: The field is of a kind that nothing here bounds.
    """
    if len(field.ends):
        raise ConfigurationError("fields with terminal ends are not bounded yet")
    N = model_network(field.tangent_network, boxes)
    return compose(field.composition, model_score(field.score_model, boxes), N)


def model_score(score: ScoreNetwork | GaussianMixture, boxes: Boxes) -> TaylorModel:
    """Returns the models of the raw score S."""
    if isinstance(score, GaussianMixture):
        return MixtureModel(score).gradient(boxes).scaled(-1.0)
    return model_network(score.network.with_last_input(1.0), boxes).scaled(1 / score.scale)


def has_dual(field: GuidingField) -> bool:
    """Whether `dual_field` bounds the derivatives of a field."""
    networks = [field.tangent_network]
    if isinstance(field.score_model, ScoreNetwork):
        networks.append(field.score_model.network)
    return not len(field.ends) and all(
        isinstance(find_expansion(network.activation.name), Differentiable)
        for network in networks
    )


def dual_field(field: GuidingField, boxes: Boxes) -> DualModel:
    """Returns the models of m and of its derivatives, by normalised units of length.

    Raises:
        ConfigurationError: The field is of a kind whose derivatives nothing here bounds.
    """
    if not has_dual(field):
        raise ConfigurationError(
            "only derivatives of smooth fields of closed paths are bounded"
        )
    S = dual_score(field.score_model, boxes)
    return compose(field.composition, S, dual_network(field.tangent_network, boxes))


def dual_score(score: ScoreNetwork | GaussianMixture, boxes: Boxes) -> DualModel:
    """Returns the models of the raw score S and of its derivatives."""
    if isinstance(score, GaussianMixture):
        return dual_mixture(score, boxes)
    return dual_network(score.network.with_last_input(1.0), boxes).scaled(1 / score.scale)


Model = TypeVar("Model", TaylorModel, DualModel)


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
