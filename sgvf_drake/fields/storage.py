"""Fields on disk: one safetensors file, read without pickle and without torch.

The tensors are the weights and the waypoints; the header holds one JSON document with the
recipe, the seed, the noise level, the normalisation, the composition, the activations and the
digest of the cloud.  A file whose parts do not agree is refused.
"""

from collections.abc import Mapping
import hashlib
import json
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sgvf_drake.clouds import Origin, PointCloud
from sgvf_drake.exceptions import FieldFileError, OutputExistsError, PointCloudError
from sgvf_drake.fields.activation import SILU, find_activation
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composed import ComposedField, ScoreInducedField
from sgvf_drake.fields.composition import (
    Composition,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
)
from sgvf_drake.fields.directed import DirectedField
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron, ScoreNetwork
from sgvf_drake.fields.strands import StrandMixture, StrandNetwork
from sgvf_drake.paths import PathNetwork

# The only entry of the metadata, which safetensors writes in random order: with one, equal
# fields are equal files.
HEADER_KEY = "sgvf_drake.field"
VERSION = 3
# Version 1 had neither activations, as every network was one of SiLU, nor normalised fields;
# before version 3 a field did not hold its paths, which are found in its waypoints then.
VERSION_WITHOUT_PATHS = 2
READABLE_VERSIONS = (1, VERSION_WITHOUT_PATHS, VERSION)
OF_VERSION_1 = {"score_activation": SILU.name, "tangent_activation": SILU.name}
COMPOSITIONS: dict[type[Composition], str] = {
    RobustComposition: "robust",
    PaperComposition: "paper",
    NormalisedComposition: "normalised",
}
POINTS_KEY = "cloud.points"
SUPPORT_KEY = "support.points"
ENDS_KEY = "ends.points"
STRANDS = "strands"
# Float64, as safetensors names it.
DTYPE = "F64"

Tensors = dict[str, FloatArray]


def save_field(
    field: ScoreInducedField, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Writes `field` to `path`, whole or not at all.

    Raises:
        OutputExistsError: The file exists and `overwrite` is false.
        OSError: The folder does not exist or cannot be written.
    """
    write_whole(Path(path), _file_of(field), overwrite=overwrite)


def write_whole(path: Path, data: bytes, *, overwrite: bool) -> None:
    """Writes a file, whole or not at all; see `save_field`."""
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists; pass overwrite=True to replace it")
    # In the folder of the target, so that the last step is an atomic rename.
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def field_digest(field: ScoreInducedField) -> str:
    """Returns the SHA-256 digest of the file that a field is saved as, in hexadecimal."""
    return hashlib.sha256(_file_of(field)).hexdigest()


def _file_of(field: ScoreInducedField) -> bytes:
    learned, tensors = _learned(field)
    tensors[POINTS_KEY] = field.cloud.points
    if field.support is not None:
        tensors[SUPPORT_KEY] = field.support
    if field.end_points is not None:
        tensors[ENDS_KEY] = field.end_points
    contiguous = {key: np.ascontiguousarray(value) for key, value in tensors.items()}
    return save(contiguous, {HEADER_KEY: json.dumps(_header(field, learned))})


def _learned(field: ScoreInducedField) -> tuple[dict[str, Any], Tensors]:
    """What the header and the tensors say of score and tangent."""
    match field:
        case ComposedField(score_model=ScoreNetwork() as score, tangent_network=tangent):
            header = {
                "score_scale": score.scale,
                "score_activation": score.network.activation.name,
                "tangent_activation": tangent.activation.name,
            }
            return header, {**_pack("tangent", tangent), **_pack("score", score.network)}
        case ComposedField(tangent_network=tangent):
            header = {
                "score_scale": None,
                "score_activation": None,
                "tangent_activation": tangent.activation.name,
            }
            return header, _pack("tangent", tangent)
        case DirectedField(strands=StrandMixture() as strands):
            tensors = {
                f"{STRANDS}.points": field.cloud.denormalize(strands.points),
                f"{STRANDS}.directions": strands.directions,
                f"{STRANDS}.one_way": strands.one_way.astype(float),
            }
            return {STRANDS: "mixture"}, tensors
        case DirectedField(strands=StrandNetwork() as strands):
            header = {
                STRANDS: "two-way" if strands.two_way else "one-way",
                f"{STRANDS}_activation": strands.network.activation.name,
            }
            return header, _pack(STRANDS, strands.network)
    raise TypeError(f"{type(field).__name__} cannot be saved")


def read_field(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Returns the arguments of the field in a file; see `guiding.load_field`.

    Raises:
        FieldFileError: The file is missing, damaged, foreign or of another version.
    """
    path = Path(path)
    if not path.is_file():
        raise FieldFileError(f"{path}: no such file")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            types = {key: file.get_slice(key).get_dtype() for key in file.keys()}  # noqa: SIM118
            # NumPy has not every type of the format, and fails on the others.
            tensors = {key: file.get_tensor(key) for key in types if types[key] == DTYPE}
    except SafetensorError as error:
        raise FieldFileError(f"{path}: not a whole safetensors file ({error})") from None
    if HEADER_KEY not in metadata:
        raise FieldFileError(f"{path}: a safetensors file, but not a field of sgvf_drake")
    try:
        for key, dtype in types.items():
            if dtype != DTYPE or not np.isfinite(tensors[key]).all():
                raise ValueError(f"tensor {key} is not all finite float64")
        return _arguments(json.loads(metadata[HEADER_KEY]), tensors)
    except KeyError as error:
        raise FieldFileError(f"{path}: {error.args[0]} is missing") from None
    except (
        *(ValueError, TypeError, OverflowError, RecursionError),
        PointCloudError,
    ) as error:
        raise FieldFileError(f"{path}: {error}") from None


def _header(field: ScoreInducedField, learned: Mapping[str, Any]) -> dict[str, Any]:
    # Only where there are any, so that other files, and their digests, stay as they were.
    origin = {"origin": field.cloud.origin} if field.cloud.origin else {}
    paths = {"network": field.path_network.to_json()} if field.path_network else {}
    return {
        "version": VERSION if paths else VERSION_WITHOUT_PATHS,
        "recipe": field.recipe,
        "seed": field.seed,
        "sigma": field.sigma,
        "composition": _composition_name(field.composition),
        "gain": field.composition.gain,
        **learned,
        "shape": field.cloud.shape,
        "digest": field.cloud.digest,
        "center": field.cloud.center.tolist(),
        "unit_length": field.cloud.unit_length,
        "provenance": dict(field.provenance),
        **paths,
        **origin,
    }


def _arguments(header: Any, tensors: Tensors) -> dict[str, Any]:
    if not isinstance(header, dict):
        raise ValueError("the header is not a JSON object")
    if header["version"] not in READABLE_VERSIONS:
        readable = ", ".join(map(str, READABLE_VERSIONS))
        raise ValueError(f"version {header['version']} of the format; this reads {readable}")
    if header["version"] == 1:
        header = header | OF_VERSION_1
    shape = _checked(header, "shape", str, type(None))
    cloud = PointCloud(tensors[POINTS_KEY], shape, origin=_origin(header))
    if cloud.digest != header["digest"]:
        raise ValueError("the waypoints are not those of the header's digest")
    if (header["center"], header["unit_length"]) != (cloud.center.tolist(), cloud.unit_length):
        raise ValueError("the normalisation is not that of the waypoints")
    sigma = _positive(header, "sigma")
    for key, fewest in ((SUPPORT_KEY, 1), (ENDS_KEY, 0)):
        if key in tensors:
            count = max(fewest, tensors[key].size // cloud.dim)
            _check_shape(key, tensors[key], (count, cloud.dim))
    return {
        "cloud": cloud,
        "sigma": sigma,
        "support": tensors.get(SUPPORT_KEY),
        "end_points": tensors.get(ENDS_KEY),
        "path_network": _path_network(header),
        **_models(header, tensors, cloud, sigma),
        "composition": _composition(header, sigma),
        "recipe": _checked(header, "recipe", str),
        "seed": _checked(header, "seed", int),
        "provenance": _checked(header, "provenance", dict),
    }


def _checked(header: Mapping[str, Any], key: str, *types: type) -> Any:
    if not isinstance(header[key], types):
        raise ValueError(f"{key} cannot be {header[key]!r}")
    return header[key]


def _origin(header: Mapping[str, Any]) -> Origin | None:
    if "origin" not in header:
        return None
    latitude, longitude, height = map(float, _checked(header, "origin", list))
    return latitude, longitude, height


def _path_network(header: Mapping[str, Any]) -> PathNetwork | None:
    if header["version"] < VERSION:
        return None
    return PathNetwork.from_json(_checked(header, "network", dict))


def _positive(header: Mapping[str, Any], key: str) -> float:
    value = float(_checked(header, key, int, float))
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{key} cannot be {value}")
    return value


def _composition_name(composition: Composition) -> str:
    if isinstance(composition, RobustComposition) and not composition.projects:
        # A name of its own, so that versions that would put the projection back refuse it.
        return "unprojected"
    return COMPOSITIONS[type(composition)]


def _composition(header: Mapping[str, Any], sigma: float) -> Composition:
    match header["composition"]:
        case "robust":
            return RobustComposition(_positive(header, "gain"), sigma)
        case "unprojected":
            return RobustComposition(_positive(header, "gain"), sigma, projects=False)
        case "paper":
            return PaperComposition(_positive(header, "gain"))
        case "normalised":
            return NormalisedComposition(_positive(header, "gain"))
        case other:
            raise ValueError(f"unknown composition {other!r}")


def _models(
    header: Mapping[str, Any], tensors: Tensors, cloud: PointCloud, sigma: float
) -> dict[str, Any]:
    """The score and the tangent, or the strands of a directed field."""
    if STRANDS in header:
        return {"strands": _strands(header, tensors, cloud, sigma)}
    return {
        "score_model": _score_model(header, tensors, cloud, sigma),
        "tangent_network": _network("tangent", header, tensors, cloud.dim, cloud.dim),
    }


def _score_model(
    header: Mapping[str, Any], tensors: Tensors, cloud: PointCloud, sigma: float
) -> ScoreNetwork | GaussianMixture:
    if header["score_scale"] is None:
        return GaussianMixture(cloud.normalize(tensors.get(SUPPORT_KEY, cloud.points)), sigma)
    network = _network("score", header, tensors, cloud.dim + 1, cloud.dim)
    return ScoreNetwork(network, _positive(header, "score_scale"))


def _strands(
    header: Mapping[str, Any], tensors: Tensors, cloud: PointCloud, sigma: float
) -> StrandMixture | StrandNetwork:
    d = cloud.dim
    match header[STRANDS]:
        case "mixture":
            points, directions, one_way = (
                tensors[f"{STRANDS}.{key}"] for key in ("points", "directions", "one_way")
            )
            _check_shape(f"{STRANDS}.points", points, (max(1, len(points)), d))
            _check_shape(f"{STRANDS}.directions", directions, points.shape)
            _check_shape(f"{STRANDS}.one_way", one_way, (len(points),))
            return StrandMixture(cloud.normalize(points), directions, one_way > 0, sigma)
        case ("one-way" | "two-way") as ways:
            network = _network(STRANDS, header, tensors, 2 * d, 2 * d, passed=d)
            return StrandNetwork(network, sigma, two_way=ways == "two-way")
        case other:
            raise ValueError(f"unknown {STRANDS} {other!r}")


def _pack(prefix: str, network: Perceptron) -> Tensors:
    tensors = {}
    if network.features is not None:
        tensors[f"{prefix}.frequencies"] = network.features.frequencies
        tensors[f"{prefix}.phases"] = network.features.phases
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"{prefix}.{layer}.weight"] = weight
        tensors[f"{prefix}.{layer}.bias"] = bias
    return tensors


def _network(
    prefix: str,
    header: Mapping[str, Any],
    tensors: Tensors,
    inputs: int,
    outputs: int,
    passed: int = 0,
) -> Perceptron:
    activation = find_activation(_checked(header, f"{prefix}_activation", str))
    layers = sum(key.startswith(f"{prefix}.") for key in tensors if key.endswith(".weight"))
    weights = tuple(tensors[f"{prefix}.{layer}.weight"] for layer in range(max(layers, 1)))
    biases = tuple(tensors[f"{prefix}.{layer}.bias"] for layer in range(max(layers, 1)))
    features = None
    widths = [inputs]
    if f"{prefix}.frequencies" in tensors:
        frequencies = tensors[f"{prefix}.frequencies"]
        features = FourierFeatures(frequencies, tensors[f"{prefix}.phases"], passed)
        _check_shape(f"{prefix}.frequencies", frequencies, (len(frequencies), inputs - passed))
        _check_shape(f"{prefix}.phases", features.phases, (len(frequencies),))
        widths = [features.num_outputs]
    widths += [len(weight) for weight in weights[:-1]] + [outputs]
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        _check_shape(f"{prefix}.{layer}.weight", weight, (widths[layer + 1], widths[layer]))
        _check_shape(f"{prefix}.{layer}.bias", bias, (widths[layer + 1],))
    return Perceptron(weights, biases, features, activation)


def _check_shape(key: str, tensor: FloatArray, shape: tuple[int, ...]) -> None:
    if tensor.shape != shape:
        raise ValueError(f"tensor {key} has shape {tensor.shape}, expected {shape}")
