"""Networks from files that `torch.save` wrote: plain tensors, and nothing is unpickled.

A file holds the state dict of a perceptron, or a dict with `state_dict` and, if they are
told, `hiddens` (the hidden widths), `hidden` (the one of every hidden layer) and `activation`
(its name in torch; SiLU where none is told).
"""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any
import warnings

import torch

from sgvf_drake.exceptions import ConfigurationError, FieldFileError
from sgvf_drake.fields import Perceptron, find_activation
from sgvf_drake.fields.activation import SILU
from sgvf_drake.fields.importing import check_widths, perceptron_from_arrays

STATE_DICT = "state_dict"
TOLD = ("hiddens", "hidden", "activation")


def load_checkpoint(path: str | PathLike[str], kind: str) -> Perceptron:
    """Reads a network; its architecture is that of the shapes of its tensors.

    Args:
        path: The file.
        kind: `score`, a network of (x, t), or `tangent`, one of x.

    Raises:
        FieldFileError: The file is missing, damaged, or holds anything else; the message
            names the file and the key.
    """
    content = _read(Path(path))
    try:
        state, told = _parts(content)
        activation = told.get("activation")
        activation = find_activation(SILU.name if activation is None else activation)
        network = perceptron_from_arrays(state, activation)
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


def _parts(content: Any) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
    """Returns the state dict of a file, and what is told beside it."""
    if isinstance(content, Mapping) and STATE_DICT not in content:
        told = [key for key in TOLD if key in content]
        if told:
            raise ConfigurationError(f"{STATE_DICT} is missing beside {', '.join(told)}")
        return content, {}
    state = content[STATE_DICT] if isinstance(content, Mapping) else content
    if not isinstance(state, Mapping):
        raise ConfigurationError(f"a state dict is needed, not {type(state).__name__}")
    return state, content


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
