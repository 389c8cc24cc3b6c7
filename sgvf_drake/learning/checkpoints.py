"""Networks from files that `torch.save` wrote: plain tensors, and nothing is unpickled.

A file holds the state dict of a perceptron, or a dict in which it is one entry, under
whatever key (`state_dict`, `model_state_dict`), beside an optimizer's, an epoch, and, if they
are told, `hiddens` (the hidden widths), `hidden` (the one of every hidden layer) and
`activation` (its name in torch).
"""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any
import warnings

import torch

from sgvf_drake.exceptions import ConfigurationError, FieldFileError
from sgvf_drake.fields import Perceptron, find_activation
from sgvf_drake.fields.activation import ACTIVATIONS, SILU, Activation
from sgvf_drake.fields.importing import LAYER_KEY, check_widths, perceptron_from_arrays

STATE_DICT = "state_dict"
TOLD = ("hiddens", "hidden", "activation")


def load_checkpoint(
    path: str | PathLike[str],
    kind: str,
    *,
    key: str | None = None,
    activation: str | None = None,
) -> Perceptron:
    """Reads a network; its architecture is that of the shapes of its tensors.

    Args:
        path: The file.
        kind: `score`, a network of (x, t), or `tangent`, one of x.
        key: The entry that is the state dict; None: the only one that can be.
        activation: What follows every layer but the last, by its name in torch; None: what
            the file tells.

    Raises:
        FieldFileError: The file is missing, damaged, or holds anything else; it holds several
            state dicts and no key chooses one; nothing tells the activation of hidden layers.
            The message names the file, and the key or the option.
    """
    content = _read(Path(path))
    try:
        state, told = _parts(content, key)
        network = perceptron_from_arrays(state, _activation(state, told, activation))
        _check_hidden(network, told)
        check_widths(network, kind)
    except ConfigurationError as error:
        raise FieldFileError(f"{path}: {error}") from None
    return network


def _read(path: Path) -> Any:
    if path.is_dir():
        raise FieldFileError(f"{path}: is a folder, not a file")
    if not path.is_file():
        raise FieldFileError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            # On old formats and on scripts, which are then refused.
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True)
    # A damaged or foreign file makes torch raise almost anything.
    except Exception:
        raise FieldFileError(
            f"{path}: not a whole file of plain tensors, as torch.save(network.state_dict()) "
            "leaves it; nothing else is unpickled"
        ) from None


def _parts(content: Any, key: str | None) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
    """Returns the state dict of a file, and what is told beside it."""
    if key is not None and not (isinstance(content, Mapping) and key in content):
        raise ConfigurationError(f"there is no entry {key!r}, which --key names")
    if key is None and isinstance(content, Mapping):
        key = _key_of_state(content)
        told = [name for name in TOLD if name in content]
        if key is None and told:
            raise ConfigurationError(f"{STATE_DICT} is missing beside {', '.join(told)}")
    state = content if key is None else content[key]
    if not isinstance(state, Mapping):
        raise ConfigurationError(f"a state dict is needed, not {type(state).__name__}")
    return state, {} if key is None else content


def _key_of_state(content: Mapping[Any, Any]) -> Any:
    """Returns the key of the entry that holds layers; None: the content itself is to."""
    keys = [key for key, entry in content.items() if _holds_layers(entry)]
    if len(keys) > 1:
        names = ", ".join(map(str, keys))
        raise ConfigurationError(
            f"several entries hold a state dict: {names}; choose one with --key"
        )
    if keys:
        return keys[0]
    return STATE_DICT if STATE_DICT in content else None


def _holds_layers(entry: Any) -> bool:
    return isinstance(entry, Mapping) and any(
        isinstance(key, str) and LAYER_KEY.fullmatch(key) for key in entry
    )


def _activation(
    state: Mapping[Any, Any], told: Mapping[Any, Any], asked: str | None
) -> Activation:
    """Returns the activation that the file tells or that was asked for."""
    by_file = told.get("activation")
    name = asked if by_file is None else by_file
    if name is None:
        # Without a hidden layer there is none.
        if sum(str(key).endswith(".weight") for key in state) < 2:
            return SILU
        names = ", ".join(activation.name for activation in ACTIVATIONS)
        raise ConfigurationError(
            "a state dict does not tell what follows its layers; name it with --activation, "
            f"one of {names}"
        )
    activation = find_activation(name)
    if asked is not None and activation != find_activation(asked):
        raise ConfigurationError(f"the activation is {by_file!r}, not {asked!r}")
    return activation


def _check_hidden(network: Perceptron, told: Mapping[Any, Any]) -> None:
    found = [len(bias) for bias in network.biases[:-1]]
    for key in ("hiddens", "hidden"):
        given = told.get(key)
        if given is None:
            continue
        widths = [*given] if isinstance(given, list | tuple) else [given] * max(1, len(found))
        if any(type(width) is not int for width in widths) or widths != found:
            raise ConfigurationError(
                f"{key} is {given!r}, but the tensors have hidden layers {found}"
            )
