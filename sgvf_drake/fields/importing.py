"""Fields of networks that were trained elsewhere: plain perceptrons in the user's unit.

A score network takes (x, t) and gives d numbers, a tangent network takes x and gives d.  The
layers come as a state dict, or as a torch module, of which nothing but its methods is used:
torch is never imported.  What a module computes is read off its layers, and then compared
with what it does compute: a forward method may hold anything.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
import copy
from dataclasses import replace
from itertools import pairwise
import re
from typing import Any

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import SILU, Activation, find_activation
from sgvf_drake.fields.analytic import check_positive
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composition import NormalisedComposition, PaperComposition
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import Perceptron, ScoreNetwork

RECIPE = "imported"
# "net.0.weight", "0.bias", "module.fc1.weight": whose layer, which, and what of it.
LAYER_KEY = re.compile(r"(?P<prefix>.*?)(?P<number>\d+)\.(?P<part>weight|bias)")
# The noise level of a score that falls nowhere toward its path, and the range of the others,
# normalised units: the paper's, from a fifth of it to the unit of length.
DEFAULT_SIGMA = 0.1
SIGMA_RANGE = (0.02, 1.0)
# Float64 holds the square of it.
LARGEST_SCORE = 1e100
# Parameters of torch's activations, and the values for which they are the functions here.
PARAMETERS: dict[str, dict[str, Any]] = {
    "Softplus": {"beta": 1, "threshold": 20},
    "GELU": {"approximate": "none"},
    "ELU": {"alpha": 1},
}
# A module is compared at random points of the paper's box, to what a float32 inside of it
# may lose, relative to the largest value.
CHECK_POINTS = 32
CHECK_HALF_SIZE = 5.0
CHECK_TOLERANCE = 1e-5


def imported(
    score: Perceptron,
    tangent: Perceptron,
    cloud: PointCloud,
    gain: float,
    normalise: bool,
    files: Mapping[str, str],
) -> dict[str, Any]:
    """Returns the arguments of the field of two networks; see `guiding.import_field`."""
    check_widths(score, "score")
    check_widths(tangent, "tangent")
    dims = [tangent.num_inputs, score.num_inputs - 1, cloud.dim]
    if len(set(dims)) > 1:
        raise ConfigurationError(
            "the tangent network is of {} dimensions, the score network of {}, and the "
            "waypoints of {}".format(*dims)
        )
    check_positive("k_s", gain)
    unit = cloud.unit_length
    # With S in normalised units U times as large, k_s |S| stays what it is.
    model = ScoreNetwork(_normalised_input(score, cloud), 1 / unit)
    composition = NormalisedComposition if normalise else PaperComposition
    return {
        "cloud": cloud,
        "sigma": measured_sigma(model, cloud.normalize(cloud.points)),
        "score_model": model,
        "tangent_network": _normalised_input(tangent, cloud),
        "composition": composition(gain / unit),
        "recipe": RECIPE,
        "seed": 0,
        "provenance": {
            "import": {
                "files": dict(files),
                "score_activation": score.activation.name,
                "tangent_activation": tangent.activation.name,
                "gain": gain,
                "normalised": normalise,
            }
        },
    }


def perceptron_from_arrays(arrays: Mapping[Any, Any], activation: Activation) -> Perceptron:
    """Returns the network of a state dict: keys `<prefix>N.weight`, `.bias`, N rising.

    Args:
        arrays: NumPy arrays or torch tensors, of any float type.
        activation: What follows every layer but the last.

    Raises:
        ConfigurationError: The arrays are not the layers of a perceptron; names the key.
    """
    stems = _layer_stems(arrays)
    weights = [_array(arrays, f"{stem}.weight") for stem in stems]
    biases = [_array(arrays, f"{stem}.bias") for stem in stems]
    for stem, weight, bias in zip(stems, weights, biases, strict=True):
        if weight.ndim != 2:
            raise ConfigurationError(f"{stem}.weight is of shape {weight.shape}, no matrix")
        if bias.shape != weight.shape[:1]:
            raise ConfigurationError(
                f"{stem}.bias is of shape {bias.shape}, but {stem}.weight {weight.shape}"
            )
    for (before, a), (after, b) in pairwise(zip(stems, weights, strict=True)):
        if len(a) != b.shape[1]:
            raise ConfigurationError(
                f"{after}.weight is of shape {b.shape}, but {before}.weight {a.shape}"
            )
    return Perceptron(tuple(weights), tuple(biases), activation=activation)


def network_of(module: Any, kind: str) -> Perceptron:
    """Returns the network of a torch module; errors tell which, `score` or `tangent`."""
    try:
        return perceptron_from_module(module, kind)
    except ConfigurationError as error:
        raise ConfigurationError(f"{kind} network: {error}") from None


def perceptron_from_module(module: Any, kind: str) -> Perceptron:
    """Returns the network of a torch module whose layers are Linear and one activation.

    Args:
        module: A Sequential, or a module that holds one.  It stays as it is.
        kind: `score`, of (x, t) in one argument or two, or `tangent`, of x.

    Raises:
        ConfigurationError: It is no such module, or computes anything else; names the layer.
    """
    if not (hasattr(module, "named_modules") and hasattr(module, "state_dict")):
        raise ConfigurationError(f"a torch module is needed, not {type(module).__name__}")
    network = perceptron_from_arrays(module.state_dict(), _activation(module))
    check_widths(network, kind)
    z = np.random.default_rng(0).uniform(
        -CHECK_HALF_SIZE, CHECK_HALF_SIZE, (CHECK_POINTS, network.num_inputs)
    )
    if kind == "score":
        z[:, -1] = 1.0
    expected = network(z)
    tolerance = CHECK_TOLERANCE * np.abs(expected).max()
    for found in _evaluations(module, z, kind):
        if found.shape == expected.shape and np.abs(found - expected).max() <= tolerance:
            return network
    raise ConfigurationError(
        f"{type(module).__name__} does not compute what its layers alone do; "
        "pass their Sequential, if that is the network"
    )


def check_widths(network: Perceptron, kind: str) -> None:
    """Checks that a `score` or `tangent` network has inputs for its outputs.

    Raises:
        ConfigurationError: It has not.
    """
    inputs, outputs = network.num_inputs, len(network.biases[-1])
    if inputs != outputs + (kind == "score"):
        wanted = "d + 1 inputs (x, t)" if kind == "score" else "d inputs"
        raise ConfigurationError(
            f"a {kind} network has {wanted} and d outputs, not {inputs} and {outputs}"
        )


def measured_sigma(model: ScoreNetwork, z: FloatArray) -> float:
    """Returns the noise level of a score as it shows at the waypoints, normalised units.

    The median over those of z, (n, d), at which the score falls at all.
    """
    _, _, steepness = steepest_fall(model, z)
    falling = steepness[steepness > 0]
    if len(falling) == 0:
        return DEFAULT_SIGMA
    return float(np.clip(np.median(1 / np.sqrt(falling)), *SIGMA_RANGE))


def steepest_fall(
    model: ScoreNetwork | GaussianMixture, x: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns the score (n, d), where it falls most (n, d), unit vectors, and how fast (n,).

    On the path of a cloud of noise level sigma that is across it, and 1/sigma^2 per unit of
    length (paper, Section III-A).

    Raises:
        ConfigurationError: The score or its slope is too large, or not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        score, jacobian = model.score_and_jacobian(x)
    if not (np.abs(score).max() < LARGEST_SCORE and np.abs(jacobian).max() < LARGEST_SCORE):
        raise ConfigurationError(
            "the score network gives numbers beyond what float64 can square"
        )
    values, vectors = np.linalg.eigh(0.5 * (jacobian + np.swapaxes(jacobian, 1, 2)))
    return score, vectors[:, :, 0], -values[:, 0]


def _layer_stems(arrays: Mapping[Any, Any]) -> list[str]:
    """Returns the keys of the layers, less `.weight` and `.bias`, first layer first."""
    numbers: dict[str, int] = {}
    prefixes = []
    for key in arrays:
        match = LAYER_KEY.fullmatch(key) if isinstance(key, str) else None
        if match is None:
            raise ConfigurationError(f"{key!r} is not the weight or bias of a numbered layer")
        prefixes.append(match["prefix"])
        if prefixes[-1] != prefixes[0]:
            raise ConfigurationError(f"{key} belongs to another network than the first key")
        numbers[key.removesuffix(f".{match['part']}")] = int(match["number"])
    if not numbers:
        raise ConfigurationError("there is no layer")
    return sorted(numbers, key=lambda stem: numbers[stem])


def _array(arrays: Mapping[Any, Any], key: str) -> FloatArray:
    """Returns a float64 copy of a NumPy array or a torch tensor."""
    if key not in arrays:
        raise ConfigurationError(f"{key} is missing")
    values = arrays[key]
    try:
        # NumPy has not every type of torch, so to float64 first.
        is_tensor = hasattr(values, "detach") and values.is_floating_point()
        array = np.asarray(values.detach().cpu().double().numpy() if is_tensor else values)
    except (TypeError, ValueError, RuntimeError):
        # Ragged lists, sparse tensors, and those without data.
        array = np.empty(0, dtype=object)
    if array.dtype.kind != "f":
        raise ConfigurationError(f"{key} is not a plain array of floating-point numbers")
    if not np.isfinite(array).all():
        raise ConfigurationError(f"{key} is not all finite")
    return np.array(array, dtype=np.float64)


def _normalised_input(network: Perceptron, cloud: PointCloud) -> Perceptron:
    """Returns the network of z = (x - centre) / U: the map becomes part of the first layer."""
    position, rest = np.split(network.weights[0], [cloud.dim], axis=1)
    weight = np.concatenate([position * cloud.unit_length, rest], axis=1)
    bias = network.biases[0] + position @ cloud.center
    return replace(
        network, weights=(weight, *network.weights[1:]), biases=(bias, *network.biases[1:])
    )


def _activation(module: Any) -> Activation:
    """Returns the activation between the Linear layers of a module."""
    steps = [
        (name, leaf)
        for name, leaf in module.named_modules(remove_duplicate=False)
        if not any(True for _ in leaf.children()) and not _does_nothing(name, leaf)
    ]
    activations = []
    for number, (name, leaf) in enumerate(steps):
        is_layer, described = type(leaf).__name__ == "Linear", _describe(name, leaf)
        if is_layer != (number % 2 == 0):
            wanted = "Linear layer" if number % 2 == 0 else "activation"
            raise ConfigurationError(f"{described} stands where the next {wanted} has to be")
        if not is_layer:
            activations.append(_as_activation(leaf, described))
    if steps and len(steps) % 2 == 0:
        raise ConfigurationError(f"{_describe(*steps[-1])} comes after the last Linear layer")
    names = sorted({activation.name for activation in activations})
    if len(names) > 1:
        raise ConfigurationError(f"the activations differ: {', '.join(names)}")
    return activations[0] if activations else SILU


def _does_nothing(name: str, leaf: Any) -> bool:
    kind = type(leaf).__name__
    if "Dropout" in kind and leaf.training:
        raise ConfigurationError(f"{_describe(name, leaf)} is in training; call eval() first")
    return "Dropout" in kind or kind in ("Identity", "Sequential")


def _describe(name: str, leaf: Any) -> str:
    return f"layer {name!r} ({type(leaf).__name__})"


def _as_activation(leaf: Any, described: str) -> Activation:
    kind = type(leaf).__name__
    try:
        activation = find_activation(kind)
    except ConfigurationError as error:
        raise ConfigurationError(f"{described}: {error}") from None
    for parameter, needed in PARAMETERS.get(kind, {}).items():
        value = getattr(leaf, parameter, needed)
        if value != needed:
            raise ConfigurationError(f"{described} has {parameter}={value!r}, not {needed!r}")
    return activation


def _evaluations(module: Any, z: FloatArray, kind: str) -> Iterator[FloatArray]:
    """Gives what a module makes of points, for each way to call it that works."""
    twin = copy.deepcopy(module).cpu().double().eval()
    inputs = next(iter(twin.state_dict().values())).new_tensor(z)
    calls: list[tuple[Any, ...]] = [(inputs,)]
    if kind == "score":
        # Times as a column, one for each point, or one for all.
        times = (inputs[:, -1:], inputs[:, -1], inputs[0, -1], 1.0)
        calls += [(inputs[:, :-1], t) for t in times]
    for arguments in calls:
        # Code of others, called in a way that it may not be made for, can raise anything.
        with suppress(Exception):
            yield np.asarray(twin(*arguments).detach().numpy())
