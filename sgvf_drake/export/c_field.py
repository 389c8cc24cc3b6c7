"""A field as the template of its C code takes it: names, sizes, constants and arrays."""

from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.export.c_numbers import CArray, literal, storage_type
from sgvf_drake.fields import (
    ComposedField,
    DirectedField,
    GaussianMixture,
    Perceptron,
    ScoreNetwork,
    StrandMixture,
    StrandNetwork,
)
from sgvf_drake.fields.activation import NORMAL_RANGE
from sgvf_drake.fields.compiled.packing import (
    DATA_END,
    GAIN,
    KIND,
    LEAST_EXPONENT,
    NORMALISED,
    PAPER,
    PROJECTION_FACTOR,
    PROJECTS,
    ROBUST,
    SOFTENING,
    TANGENT_SHARE,
    pack_composed,
)
from sgvf_drake.fields.strands import ONE_WAY_SHARPNESS, TWO_WAY_SHARPNESS

KINDS = {PAPER: "paper", NORMALISED: "normalised", ROBUST: "robust"}


@dataclass
class FieldCode:
    """What the template says of a field.

    Attributes:
        precision: One of `PRECISIONS`.
        constants: Everything but the arrays.
        arrays: All of them.
    """

    precision: str
    constants: dict[str, Any] = field(default_factory=dict)
    arrays: list[CArray] = field(default_factory=list)

    @classmethod
    def of(cls, field: ComposedField | DirectedField, precision: str) -> "FieldCode":
        """Returns that of a field.

        Raises:
            ConfigurationError: If its composition is of a kind that has no C code.
        """
        code = cls(precision)
        code._add_composition(field)
        match field:
            case DirectedField(strands=StrandMixture() as mixture):
                code._add_strands(mixture)
            case DirectedField(strands=StrandNetwork() as network):
                code.constants |= {
                    "two_way": network.two_way,
                    "score_scale": code.real(network.sigma),
                }
                code._add_networks(network=network.network)
            case ComposedField(score_model=GaussianMixture() as mixture):
                code._add_mixture("score_points", mixture.points, mixture.sigma)
                code._add_networks(tangent_network=field.tangent_network)
            case ComposedField(score_model=ScoreNetwork() as model):
                code.constants["score_scale"] = code.real(model.scale)
                # At the end of the data, where score networks are asked.
                score = model.network.with_last_input(DATA_END)
                code._add_networks(score_network=score, tangent_network=field.tangent_network)
        return code

    @property
    def real_type(self) -> str:
        """The type in which is computed."""
        return "float" if self.precision == "float" else "double"

    def real(self, value: float) -> str:
        """Returns a constant of this type."""
        return literal(value, self.real_type)

    def _add(self, name: str, values: np.ndarray, type: str) -> None:
        self.arrays.append(CArray(name, type, np.ascontiguousarray(values)))

    def _add_composition(self, field: ComposedField | DirectedField) -> None:
        settings, ends, width = pack_composed(field)
        following, resting = settings
        d, directed = field.dim, isinstance(field, DirectedField)
        self.constants |= {
            "real": self.real_type,
            # The suffix of functions and constants.
            "f": "f" if self.real_type == "float" else "",
            "dim": d,
            "directed": directed,
            "inputs": 2 * d if directed else d,
            "center": ", ".join(map(literal, field.cloud.center)),
            "kind": KINDS[int(following[KIND])],
            "gain": self.real(following[GAIN]),
            "uses_direction": following[KIND] != PAPER,
            "softening": self.real(following[SOFTENING]),
            "projects": int(following[PROJECTS]),
            "projection_factor": self.real(following[PROJECTION_FACTOR]),
            "share": self.real(following[TANGENT_SHARE]),
            "num_ends": len(ends),
            "rest_variance": self.real(width**2),
            "rest_projects": int(resting[PROJECTS]),
            "rest_share": self.real(resting[TANGENT_SHARE]),
            "normal_range": self.real(NORMAL_RANGE),
            "root_two": self.real(math.sqrt(2)),
            "root_two_pi": self.real(math.sqrt(2 * math.pi)),
            "mixture": None,
            "networks": [],
            "two_way": False,
            "width": 0,
            "activations": [],
            "feature_types": [],
            "layer_types": [],
        }
        if len(ends):
            self._add("ends", ends, storage_type(self.precision, [ends]))

    def _add_mixture(self, name: str, points: FloatArray, sigma: float) -> None:
        type = storage_type(self.precision, [points])
        self._add(name, points, type)
        self.constants |= {
            "mixture": {"points": name, "count": len(points), "type": type},
            "variance": self.real(sigma**2),
            "least_exponent": self.real(LEAST_EXPONENT),
        }

    def _add_strands(self, mixture: StrandMixture) -> None:
        self._add_mixture("strands_points", mixture.points, mixture.sigma)
        self._add("strands_directions", mixture.directions, self.constants["mixture"]["type"])
        self._add("strands_two_way", ~mixture.one_way, "unsigned char")
        self.constants |= {
            "kappa_one_way": self.real(ONE_WAY_SHARPNESS),
            "kappa_two_way": self.real(TWO_WAY_SHARPNESS),
            "kappa_largest": self.real(mixture.sharpness.max()),
            "log_two": self.real(math.log(2)),
        }

    def _add_networks(self, **networks: Perceptron) -> None:
        told = [self._network(name, network) for name, network in networks.items()]
        layers = [layer for network in told for layer in network["layers"]]
        features = [network["features"] for network in told if network["features"]]
        self.constants |= {
            "networks": told,
            "width": max(max(layer["inputs"], layer["outputs"]) for layer in layers),
            # Of a network without hidden layers there is none.
            "activations": sorted(
                {one["activation"] for one in told if len(one["layers"]) > 1}
            ),
            "feature_types": sorted({one["type"] for one in features}),
            "layer_types": sorted({layer["type"] for layer in layers}),
        }

    def _network(self, name: str, network: Perceptron) -> dict[str, Any]:
        features, layers, buffers = network.features, [], ("first", "second")
        reads_features = features is not None
        for number, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            type = storage_type(self.precision, [W, b])
            self._add(f"{name}_weights_{number + 1}", W.T, type)
            self._add(f"{name}_bias_{number + 1}", b, type)
            layers.append(
                {
                    "type": type,
                    "inputs": W.shape[1],
                    "outputs": W.shape[0],
                    "apart": "WIDTH" if reads_features or number else "INPUTS",
                    "source": buffers[number % 2] if reads_features or number else "in",
                    "target": buffers[1 - number % 2],
                }
            )
        used = {layer[end] for layer in layers for end in ("source", "target")} - {"in"}
        told = None
        if features is not None:
            arrays = [features.frequencies, features.phases]
            type = storage_type(self.precision, arrays)
            self._add(f"{name}_frequencies", arrays[0], type)
            self._add(f"{name}_phases", arrays[1], type)
            count, size = features.frequencies.shape
            told = {"type": type, "count": count, "size": size}
        return {
            "name": name,
            "features": told,
            "layers": layers,
            "buffers": sorted(f"{name}[ROWS * WIDTH]" for name in used),
            "outputs": len(network.biases[-1]),
            "activation": network.activation.name,
        }
