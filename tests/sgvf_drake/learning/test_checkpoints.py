from collections import OrderedDict
import os
import pickle

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake import FieldFileError
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.learning.checkpoints import load_checkpoint

SCORE, TANGENT = [3, 16, 16, 2], [2, 16, 2]


@pytest.fixture
def save(tmp_path):
    """Saves anything with torch, and returns the path."""

    def write(content, name="net.pth", **options):
        torch.save(content, tmp_path / name, **options)
        return tmp_path / name

    return write


def prefixed(network, prefix="net."):
    return OrderedDict(
        (f"{prefix}{key}", tensor) for key, tensor in network.state_dict().items()
    )


def in_torch(network, x):
    with torch.no_grad():
        return network.double()(torch.as_tensor(x)).numpy()


FORMS = {
    "plain": lambda network: network.state_dict(),
    "prefixed": prefixed,
    "data parallel": lambda network: prefixed(network, "module.net."),
    "hiddens": lambda network: {"state_dict": prefixed(network), "hiddens": [16, 16]},
    "hiddens as a tuple": lambda network: {
        "state_dict": network.state_dict(),
        "hiddens": (16, 16),
    },
    "hidden": lambda network: {"state_dict": network.state_dict(), "hidden": 16},
    "both and more": lambda network: {
        "state_dict": network.state_dict(),
        "hiddens": [16, 16],
        "hidden": 16,
        "activation": "silu",
        "epoch": 10_000,
        "loss": 0.3,
    },
    "nothing told": lambda network: {"state_dict": network.state_dict()},
    "told as none": lambda network: {"state_dict": network.state_dict(), "activation": None},
    "parameters": lambda network: dict(network.named_parameters()),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_every_form_of_a_file_is_the_same_network(make_sequential, save, form, dtype):
    network = make_sequential(SCORE, dtype=dtype)
    loaded = load_checkpoint(save(form(network)), "score")
    assert loaded.activation.name == "SiLU"
    x = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    np.testing.assert_allclose(loaded(x), in_torch(network, x), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("spell", [str, str.lower])
@pytest.mark.parametrize("name", [activation.name for activation in ACTIVATIONS])
def test_the_activation_is_the_one_that_is_told(make_sequential, save, name, spell):
    network = make_sequential(TANGENT, name)
    content = {"state_dict": prefixed(network), "hidden": 16, "activation": spell(name)}
    loaded = load_checkpoint(str(save(content)), "tangent")
    x = np.random.default_rng(0).uniform(-5, 5, (50, 2))
    np.testing.assert_allclose(loaded(x), in_torch(network, x), rtol=1e-12, atol=1e-13)


def test_the_old_format_of_torch_is_read_too(make_sequential, save):
    network = make_sequential(TANGENT)
    path = save(network.state_dict(), _use_new_zipfile_serialization=False)
    x = np.random.default_rng(0).uniform(-5, 5, (50, 2))
    loaded = load_checkpoint(path, "tangent")
    np.testing.assert_allclose(loaded(x), in_torch(network, x), rtol=1e-12, atol=1e-13)


def test_reading_leaves_the_state_of_torch_alone(make_sequential, save):
    path = save(make_sequential(TANGENT).state_dict())
    before = torch.get_rng_state()
    load_checkpoint(path, "tangent")
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_default_dtype() == torch.float32


def told(**entries):
    return lambda state: {"state_dict": state, **entries}


def changed(key, change):
    return lambda state: state | {key: change(state[key])}


BAD_CONTENT = {
    "a tensor": (lambda state: state["0.bias"], "a state dict is needed, not Tensor"),
    "a list": (lambda state: [*state.values()], "a state dict is needed, not list"),
    "a number": (lambda state: 3, "a state dict is needed, not int"),
    "no state": (told(state_dict=None), "a state dict is needed, not NoneType"),
    "empty": (lambda state: {}, "there is no layer"),
    "state dict missing": (
        lambda state: {"hiddens": [16, 16], "activation": "SiLU"},
        "state_dict is missing beside hiddens, activation",
    ),
    "other wrapping": (lambda state: {"model": state}, "'model' is not the weight or bias"),
    "missing bias": (
        lambda state: {key: state[key] for key in state if key != "2.bias"},
        "2.bias is missing",
    ),
    "extra tensor": (
        lambda state: state | {"sigma": torch.ones(1)},
        "'sigma' is not the weight or bias",
    ),
    "shapes": (changed("2.weight", lambda a: a[:, 1:]), r"2.weight is of shape \(16, 15\)"),
    "NaN": (changed("2.weight", lambda a: a * torch.nan), "2.weight is not all finite"),
    "integers": (changed("0.bias", lambda a: a.long()), "0.bias is not a plain array"),
    "inputs": (changed("0.weight", lambda a: a[:, 1:]), "a score network .* not 2 and 2"),
    "outputs": (
        lambda state: state | {"4.weight": torch.ones(3, 16), "4.bias": torch.ones(3)},
        "a score network .* not 3 and 3",
    ),
    "unknown activation": (told(activation="Mish"), "unknown activation 'Mish'"),
    "activation is no name": (told(activation=3), "unknown activation 3"),
    "hiddens disagree": (
        told(hiddens=[16, 8]),
        r"hiddens is \[16, 8\], but the tensors have hidden layers \[16, 16\]",
    ),
    "hiddens are fewer": (told(hiddens=[16]), r"hiddens is \[16\], but"),
    "hiddens are none": (told(hiddens=[]), r"hiddens is \[\], but"),
    "hidden disagrees": (told(hidden=64), r"hidden is 64, but .* \[16, 16\]"),
    "hidden is true": (told(hidden=True), "hidden is True, but"),
    "hiddens are text": (told(hiddens="16, 16"), "hiddens is '16, 16', but"),
    "hiddens are tensors": (told(hiddens=[torch.ones(2), 16]), "hiddens is .* but"),
}


@pytest.mark.parametrize(("spoil", "match"), BAD_CONTENT.values(), ids=BAD_CONTENT)
def test_content_that_is_no_network_is_refused(make_sequential, save, spoil, match):
    state = dict(make_sequential(SCORE).state_dict())
    path = save(spoil(state))
    with pytest.raises(FieldFileError, match=rf"net\.pth: {match}"):
        load_checkpoint(path, "score")


def test_a_hidden_width_of_a_network_without_hidden_layers_is_refused(make_sequential, save):
    content = {"state_dict": make_sequential([2, 2]).state_dict(), "hidden": 16}
    with pytest.raises(FieldFileError, match=r"hidden is 16, but the tensors have .* \[\]"):
        load_checkpoint(save(content), "tangent")


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(FieldFileError, match=r"absent\.pth: no such file"):
        load_checkpoint(tmp_path / "absent.pth", "score")
    with pytest.raises(FieldFileError, match="is a folder"):
        load_checkpoint(tmp_path, "score")


@pytest.mark.parametrize("old", [False, True], ids=["zip", "old format"])
@pytest.mark.parametrize("kept", [0, 1, 10, 0.3, 0.9, -1])
def test_a_truncated_file_is_refused(make_sequential, save, kept, old):
    state = make_sequential(SCORE).state_dict()
    path = save(state, _use_new_zipfile_serialization=not old)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole)) if isinstance(kept, float) else kept])
    with pytest.raises(FieldFileError, match=r"net\.pth: not a whole file of plain tensors"):
        load_checkpoint(path, "score")


def test_random_damage_is_either_harmless_or_told(make_sequential, save):
    path = save(make_sequential(TANGENT).state_dict())
    whole = path.read_bytes()
    rng = np.random.default_rng(6)
    messages = []
    for _ in range(200):
        data = bytearray(whole)
        for position in rng.integers(len(whole), size=3):
            data[position] = rng.integers(256)
        path.write_bytes(data)
        try:
            load_checkpoint(path, "tangent")
        except FieldFileError as error:
            messages.append(str(error))
    assert all("net.pth: " in message and "\n" not in message for message in messages)
    assert len(messages) > 20


class Trap:
    """Unpickling it leaves a trace."""

    def __reduce__(self):
        return os.mkdir, ("sprung",)


@pytest.mark.parametrize("kind", ["pickle", "torch", "old torch", "module", "beside a state"])
def test_nothing_is_unpickled(make_sequential, tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    state = make_sequential(TANGENT).state_dict()
    path = tmp_path / "trap.pth"
    if kind == "pickle":
        path.write_bytes(pickle.dumps(Trap()))
    elif kind == "module":
        torch.save(nn.Sequential(nn.Linear(2, 2)), path)
    else:
        content = {"state_dict": state, "notes": Trap()} if "beside" in kind else Trap()
        torch.save(content, path, _use_new_zipfile_serialization=kind != "old torch")
    with pytest.raises(FieldFileError, match=r"trap\.pth: .* nothing else is unpickled"):
        load_checkpoint(path, "tangent")
    assert os.listdir(tmp_path) == ["trap.pth"]


@pytest.mark.parametrize("kind", ["text", "npy", "safetensors"])
def test_other_kinds_of_files_are_refused(make_sequential, tmp_path, kind):
    path = tmp_path / "other"
    if kind == "text":
        path.write_text("x,y\n1,2\n" * 20)
    elif kind == "npy":
        with path.open("wb") as stream:
            np.save(stream, np.zeros((3, 2)))
    else:
        from safetensors.torch import save_file

        save_file(make_sequential(TANGENT).state_dict(), path)
    with pytest.raises(FieldFileError, match="other: not a whole file of plain tensors"):
        load_checkpoint(path, "tangent")
