"""A guiding field as the plain arrays that `evaluation.evaluate` takes; no numba here."""

from dataclasses import replace
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.composed import ComposedField, ScoreInducedField
from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_RANGE,
    UNIT_SOFTENING,
    Composition,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
)
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import Perceptron, ScoreNetwork
from sgvf_drake.fields.rest import Rest
from sgvf_drake.fields.strands import StrandMixture, StrandNetwork

PAPER, NORMALISED, ROBUST = range(3)
"""The kinds of composition."""

# Where the settings of a composition hold what; see `pack_composition`.
KIND, GAIN, SOFTENING, PROJECTS, PROJECTION_FACTOR, TANGENT_SHARE = range(6)

# Where the sizes of a network hold what; see `pack_network`.
ACTIVATION, NUM_FREQUENCIES, FIRST_WIDTH = range(3)

ONE_WAY, TWO_WAY = range(2)
"""How strands are travelled."""

LEAST_EXPONENT = -50.0
"""Of a waypoint's share beside the nearest one's: 2e-22, where rounding is 1e-16."""

PackedNetwork = tuple[IntArray, FloatArray]
"""Sizes and numbers."""

DATA_END = 1.0
"""The time at which a score network is asked."""

CACHE_LINE = 64
"""Bytes, on nearly all processors of today."""


def pack_learned(field: ComposedField) -> tuple[Any, ...]:
    """Returns the arguments that hold what was learned: all that is large."""
    return (
        np.array(field.cloud.center),
        field.cloud.unit_length,
        *_pack_score(field.score_model),
        *pack_network(field.tangent_network),
    )


def pack_composed(field: ScoreInducedField) -> tuple[FloatArray, FloatArray, float]:
    """Returns the arguments that say how it is put together.

    They are the settings of the compositions away from the ends of open paths and at them,
    (2, 6), the ends, (E, d) in normalised units, and the width of the region of rest.
    """
    settings = pack_composition(field.composition)
    # The other compositions know no ends.
    if len(field.ends) == 0 or not isinstance(field.composition, RobustComposition):
        return np.array([settings, settings]), np.empty((0, field.dim)), 1.0
    rest = Rest.at(field.cloud.normalize(field.ends), field.composition)
    resting = pack_composition(rest.composition)
    return np.array([settings, resting]), rest.ends, rest.width


def pack_strands(strands: StrandMixture | StrandNetwork) -> PackedNetwork:
    """Returns strands as `strands.strands_jet` or `strands.learned_strands_jet` takes them."""
    if isinstance(strands, StrandNetwork):
        sizes, numbers = pack_network(strands.network)
        all_ways = TWO_WAY if strands.two_way else ONE_WAY
        return np.insert(sizes, 0, all_ways), numbers
    ways = np.where(strands.one_way, ONE_WAY, TWO_WAY)
    rows = np.column_stack((strands.points, strands.directions, strands.sharpness, ways))
    return np.empty(0, dtype=np.int64), rows.ravel()


def pack_composition(composition: Composition) -> tuple[float, ...]:
    """Returns kind, gain, softening, and, of the robust kind, what its projection needs."""
    match composition:
        case RobustComposition():
            return (
                ROBUST,
                composition.gain,
                DIRECTION_SOFTENING,
                float(composition.projects),
                (composition.sigma / PROJECTION_RANGE) ** 2,
                composition.tangent_share,
            )
        case NormalisedComposition():
            return NORMALISED, composition.gain, UNIT_SOFTENING, 0.0, 0.0, 1.0
        case PaperComposition():
            return PAPER, composition.gain, 0.0, 0.0, 0.0, 1.0
    raise ConfigurationError(f"{type(composition).__name__} has no compiled form")


def pack_network(network: Perceptron) -> PackedNetwork:
    """Returns a network as its sizes and its numbers.

    The sizes are the code of its activation, its number of frequencies, and the widths of
    all layers from the inputs of the first; the numbers frequencies and phases, and W^T and
    b of each layer, one after the other.
    """
    features = network.features
    num_frequencies = 0 if features is None else len(features.phases)
    widths = [network.weights[0].shape[1], *map(len, network.biases)]
    arrays = [] if features is None else [features.frequencies, features.phases]
    for weight, bias in zip(network.weights, network.biases, strict=True):
        arrays += [weight.T, bias]
    sizes = [ACTIVATIONS.index(network.activation), num_frequencies, *widths]
    return np.array(sizes, dtype=np.int64), _aligned(arrays)


def _pack_score(model: ScoreNetwork | GaussianMixture) -> PackedNetwork:
    """Returns a score; no sizes say that the numbers are variance and centres of a mixture."""
    if isinstance(model, GaussianMixture):
        numbers = np.concatenate([[model.sigma**2], model.points.T.ravel()])
        return np.empty(0, dtype=np.int64), numbers
    network = model.network.with_last_input(DATA_END)
    weights = (*network.weights[:-1], network.weights[-1] / model.scale)
    biases = (*network.biases[:-1], network.biases[-1] / model.scale)
    return pack_network(replace(network, weights=weights, biases=biases))


def _aligned(arrays: list[FloatArray]) -> FloatArray:
    """Returns arrays, flattened, one after the other, from the start of a cache line on.

    Rows of weights then mostly start with one too, and fewer loads have to be split.
    """
    numbers = np.concatenate([array.ravel() for array in arrays])
    memory = np.empty(len(numbers) + CACHE_LINE // numbers.itemsize)
    start = -memory.ctypes.data % CACHE_LINE // numbers.itemsize
    aligned = memory[start : start + len(numbers)]
    aligned[:] = numbers
    return aligned
