"""The one function that is compiled and cached: a guiding field's value and Jacobian."""

from typing import Any

import numpy as np

from sgvf_drake import compiling
from sgvf_drake.compiling import digest, kernel, part
from sgvf_drake.fields import activation as constants_of_activation
from sgvf_drake.fields import composition as constants_of_composition
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.compiled import (
    activation,
    composition,
    mixture,
    perceptron,
    rest,
)
from sgvf_drake.fields.compiled.composition import composed_jet
from sgvf_drake.fields.compiled.mixture import score_jet
from sgvf_drake.fields.compiled.perceptron import network_jet
from sgvf_drake.fields.compiled.rest import blended_jet


def _make_evaluate(sources: int) -> Any:
    @kernel
    def evaluate(
        x: FloatArray,
        center: FloatArray,
        unit_length: float,
        score_sizes: np.ndarray,
        score_numbers: FloatArray,
        tangent_sizes: np.ndarray,
        tangent_numbers: FloatArray,
        compositions: FloatArray,
        ends: FloatArray,
        rest_width: float,
    ) -> FloatArray:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        z = np.empty(len(x))
        for i in range(len(x)):
            z[i] = (x[i] - center[i]) / unit_length
        # Without sizes it is a mixture.  A function for this costs a second to compile.
        if len(score_sizes) == 0:
            S = score_jet(score_numbers[1:], score_numbers[0], z)
        else:
            S = network_jet(score_sizes, score_numbers, z)
        N = network_jet(tangent_sizes, tangent_numbers, z)
        m = composed_jet(compositions[0], S, N)
        if len(ends) > 0:
            m = blended_jet(m, composed_jet(compositions[1], S, N), ends, rest_width, z)
        return _flattened(m, unit_length)

    return evaluate


@part
def _flattened(m: FloatArray, unit_length: float) -> FloatArray:
    """The value and then the Jacobian by rows, in the unit of the waypoints."""
    d = m.shape[1]
    flat = np.empty(d + d * d)
    for i in range(d):
        flat[i] = m[0, i]
        for j in range(d):
            flat[d + d * i + j] = m[1 + j, i] / unit_length
    return flat


SOURCES = (
    activation,
    compiling,
    composition,
    constants_of_activation,
    constants_of_composition,
    mixture,
    perceptron,
    rest,
)
"""Every other module whose functions or constants are compiled into `evaluate`."""

evaluate = _make_evaluate(digest(*SOURCES))
"""Returns m and J by rows, flattened to (d + d^2,); the arguments are those of `packing`."""
