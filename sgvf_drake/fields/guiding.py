"""`GuidingField`: a guiding vector field, with its ways from files and modules and to them."""

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.analytic import AnalyticField
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.compiled import CompiledField
from sgvf_drake.fields.composed import ComposedField
from sgvf_drake.fields.composition import PAPER_GAIN
from sgvf_drake.fields.directed import DirectedField
from sgvf_drake.fields.importing import imported, network_of
from sgvf_drake.fields.perceptron import Perceptron
from sgvf_drake.fields.storage import read_field, save_field


class GuidingField(ComposedField):
    """The score-induced guiding vector field m = s + v of a cloud of waypoints.

    Calls take and return NumPy float64 in the unit of the waypoints, for one point (d,) or
    a batch (n, d).  |m| is about 1 on the path whatever the unit, so speed times m is a
    velocity.  The attributes are those of `ComposedField`.
    """

    @classmethod
    def from_torch(
        cls,
        score: Any,
        tangent: Any,
        cloud: PointCloud,
        *,
        gain: float = PAPER_GAIN,
        normalise: bool = False,
    ) -> "GuidingField":
        """Returns the field m = s + v of networks that were trained elsewhere.

        Args:
            score: A torch module of Linear layers with one activation in between, of the
                position and the time, (x, t), in the unit of the waypoints; it gives the
                score S at t = 1.
            tangent: The same of x alone; it gives v.
            cloud: The waypoints.
            gain: k_s of s = tanh(k_s |S|) S / |S|, with S as the network gives it.
            normalise: Whether m is brought to length one.

        Raises:
            ConfigurationError: A module is anything else; the message names the layer.
        """
        networks = network_of(score, "score"), network_of(tangent, "tangent")
        return import_field(*networks, cloud, gain=gain, normalise=normalise)

    def compiled(self) -> CompiledField:
        """Returns the same field, compiled by numba for calls with one point at a time.

        Only then is numba imported, which takes about a second.
        """
        return CompiledField(self)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the field as one safetensors file; see `storage.save_field`."""
        save_field(self, path, overwrite=overwrite)


def load_field(path: str | PathLike[str]) -> GuidingField | DirectedField:
    """Reads a field that was saved.

    Args:
        path: The file.

    Returns:
        A `DirectedField` if its paths cross, branch, or are travelled either way.

    Raises:
        FieldFileError: The file is missing, damaged, foreign or of another version.
    """
    arguments = read_field(path)
    return (DirectedField if "strands" in arguments else GuidingField)(**arguments)


def load_guiding_field(path: str | PathLike[str]) -> GuidingField:
    """Reads a field of the position alone; see `load_field`.

    Raises:
        FieldFileError: As `load_field`.
        ConfigurationError: The field is a directed one.
    """
    field = load_field(path)
    if isinstance(field, DirectedField):
        raise ConfigurationError(
            f"{path} is a directed field m(x, g) of a {field.network.describe(0)}; this takes "
            "fields of the position alone"
        )
    return field


def import_field(
    score: Perceptron,
    tangent: Perceptron,
    cloud: PointCloud,
    *,
    gain: float = PAPER_GAIN,
    normalise: bool = False,
    files: Mapping[str, str] | None = None,
) -> GuidingField:
    """Returns the field m = s + v of two networks that work in the unit of the waypoints.

    Args:
        score: d + 1 inputs (x, t), d outputs: the score S where t = 1.
        tangent: d inputs, d outputs: the tangent field v.
        cloud: The waypoints; their extent is the normalisation.
        gain: k_s of s = tanh(k_s |S|) S / |S|, with S per unit of the waypoints.
        normalise: Whether m is brought to length one.
        files: The names of the files that they come from, for the provenance.

    Raises:
        ConfigurationError: The networks and the waypoints do not fit together, or the gain is
            not a positive number.
    """
    return GuidingField(**imported(score, tangent, cloud, gain, normalise, files or {}))


@dataclass(frozen=True, eq=False)
class ScoreField(AnalyticField):
    """The raw score S of a guiding field, per unit of length; as `GuidingField.score`.

    Attributes:
        field: The guiding field.
    """

    field: ComposedField

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.field.cloud)

    def _value(self, z: FloatArray) -> FloatArray:
        return self.field.score_model.score(z) / self.cloud.unit_length

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        S, J = self.field.score_model.score_and_jacobian(z)
        return S / self.cloud.unit_length, J / self.cloud.unit_length


@dataclass(frozen=True, eq=False)
class TangentField(AnalyticField):
    """The tangent field v of a guiding field, no unit; as `GuidingField.tangent`.

    Its zeros are those of the tangent network.

    Attributes:
        field: The guiding field.
    """

    field: ComposedField

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.field.cloud)

    def _value(self, z: FloatArray) -> FloatArray:
        return self.field.composition.tangent(self.field.tangent_network(z))

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        N, J = self.field.tangent_network.value_and_jacobian(z)
        v, by_network = self.field.composition.tangent_and_partial(N)
        return v, by_network @ J
