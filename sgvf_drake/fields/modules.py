"""Torch modules as perceptrons, and fields of them; torch itself is never imported.

What a module computes is read off its layers, and then compared with what it does compute:
a forward method may hold anything.
"""

from collections.abc import Iterator
from contextlib import suppress
import copy
from typing import Any

import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import SILU, Activation, find_activation
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.guiding import GuidingField
from sgvf_drake.fields.importing import check_widths, import_field, perceptron_from_arrays
from sgvf_drake.fields.perceptron import Perceptron
from sgvf_drake.paths import PointCloud

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


def field_from_modules(
    score: Any, tangent: Any, cloud: PointCloud, *, gain: float, normalise: bool
) -> GuidingField:
    """Returns the field of two torch modules; see `GuidingField.from_torch`.

    Raises:
        ConfigurationError: A module is no plain perceptron, or they do not fit together.
    """
    return import_field(
        _named(score, "score"),
        _named(tangent, "tangent"),
        cloud,
        gain=gain,
        normalise=normalise,
    )


def _named(module: Any, kind: str) -> Perceptron:
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
