"""Networks from files of torch: every usual form is read, and nothing is unpickled."""

from collections import OrderedDict
import os
import pickle

import numpy as np
import pytest
from safetensors.torch import save_file
import torch
from torch import nn

from sgvf_drake import FieldFileError
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.learning.checkpoints import load_checkpoint
from tests.helpers import Trap

SCORE, TANGENT = [3, 16, 16, 2], [2, 16, 2]


@pytest.fixture
def save(tmp_path):
    """Saves anything with torch, and returns the path."""

    def write(content, **options):
        torch.save(content, tmp_path / "net.pth", **options)
        return tmp_path / "net.pth"

    return write


def prefixed(network, prefix="net."):
    return OrderedDict(
        (f"{prefix}{key}", tensor) for key, tensor in network.state_dict().items()
    )


def check_same(path, network, kind, **options):
    """A file holds the function of a network in torch; returns what was read."""
    loaded = load_checkpoint(path, kind, **options)
    x = np.random.default_rng(0).uniform(-5, 5, (50, loaded.num_inputs))
    with torch.no_grad():
        expected = network.double()(torch.as_tensor(x)).numpy()
    np.testing.assert_allclose(loaded(x), expected, rtol=1e-12, atol=1e-13)
    return loaded


FORMS = (
    lambda network: network.state_dict(),
    prefixed,
    lambda network: prefixed(network, "module.net."),
    lambda network: {"state_dict": prefixed(network), "hiddens": [16, 16]},
    lambda network: {"state_dict": network.state_dict(), "hiddens": (16, 16)},
    lambda network: {"state_dict": network.state_dict(), "hidden": 16},
    lambda network: {
        "state_dict": network.state_dict(),
        "hiddens": [16, 16],
        "hidden": 16,
        "activation": "silu",
        "epoch": 10_000,
        "loss": 0.3,
    },
    lambda network: {"state_dict": network.state_dict()},
    lambda network: {"state_dict": network.state_dict(), "activation": None},
    lambda network: dict(network.named_parameters()),
    lambda network: {
        "epoch": 7,
        "model_state_dict": prefixed(network),
        "optimizer_state_dict": torch.optim.Adam(network.parameters()).state_dict(),
    },
    lambda network: {"model": network.state_dict(), "activation": "SiLU"},
)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_form_of_a_file_is_the_same_network(make_sequential, save, dtype):
    for form in FORMS:
        network = make_sequential(SCORE, dtype=dtype)
        loaded = check_same(save(form(network)), network, "score", activation="silu")
        assert loaded.activation.name == "SiLU"
    old = save(network.state_dict(), _use_new_zipfile_serialization=False)
    before = torch.get_rng_state()
    check_same(old, network, "score", activation="SiLU")
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_default_dtype() == torch.float32


def test_the_activation_is_the_one_that_is_told(make_sequential, save):
    for activation in ACTIVATIONS:
        for name in (activation.name, activation.name.lower()):
            network = make_sequential(TANGENT, activation.name)
            content = {"state_dict": prefixed(network), "hidden": 16, "activation": name}
            check_same(str(save(content)), network, "tangent")


def test_an_activation_that_is_not_told_is_asked_for(make_sequential, save):
    for name in ("ReLU", "Tanh", "SiLU"):
        network = make_sequential(TANGENT, name)
        path = save(network.state_dict())
        with pytest.raises(FieldFileError, match=r"net\.pth: .* with --activation, .* ReLU"):
            load_checkpoint(path, "tangent")
        check_same(path, network, "tangent", activation=name)
    with pytest.raises(FieldFileError, match=r"net\.pth: unknown activation 'Mish'"):
        load_checkpoint(path, "tangent", activation="Mish")
    told_tanh = save({"state_dict": network.state_dict(), "activation": "tanh"})
    with pytest.raises(FieldFileError, match="the activation is 'tanh', not 'ReLU'"):
        load_checkpoint(told_tanh, "tangent", activation="ReLU")
    assert load_checkpoint(told_tanh, "tangent", activation="Tanh").activation.name == "Tanh"
    # Without a hidden layer there is nothing to ask for.
    linear = make_sequential([2, 2])
    check_same(save(linear.state_dict()), linear, "tangent")


def test_of_several_state_dicts_one_is_chosen(make_sequential, save):
    networks = {name: make_sequential(TANGENT) for name in ("model", "ema")}
    states = {name: network.state_dict() for name, network in networks.items()}
    path = save({"epoch": 3, "activation": "SiLU"} | states)
    with pytest.raises(FieldFileError, match=r"net\.pth: several .*: model, ema; .* --key"):
        load_checkpoint(path, "tangent")
    for name, network in networks.items():
        check_same(path, network, "tangent", key=name)
    for key, match in (("raw", "no entry 'raw'"), ("epoch", "is needed, not int")):
        with pytest.raises(FieldFileError, match=match):
            load_checkpoint(path, "tangent", key=key)


def told(**entries):
    return lambda state: {"state_dict": state, **entries}


def changed(key, change):
    return lambda state: state | {key: change(state[key])}


BAD_CONTENT = (
    (lambda state: state["0.bias"], "a state dict is needed, not Tensor"),
    (lambda state: [*state.values()], "a state dict is needed, not list"),
    (lambda state: 3, "a state dict is needed, not int"),
    (told(state_dict=None), "a state dict is needed, not NoneType"),
    (lambda state: {}, "there is no layer"),
    (
        lambda state: {"hiddens": [16, 16], "activation": "SiLU"},
        "state_dict is missing beside hiddens, activation",
    ),
    (lambda state: {"model": {"net": state}}, "'model' is not the weight or bias"),
    # What else arrays can be, `test_importing` refuses.
    (changed("2.weight", lambda a: a * torch.nan), "2.weight is not all finite"),
    (changed("0.weight", lambda a: a[:, 1:]), "a score network .* not 2 and 2"),
    (told(activation="Mish"), "unknown activation 'Mish'"),
    (told(activation=3), "unknown activation 3"),
    (
        told(hiddens=[16, 8]),
        r"hiddens is \[16, 8\], but the tensors have hidden layers \[16, 16\]",
    ),
    (told(hiddens=[16]), r"hiddens is \[16\], but"),
    (told(hiddens=[]), r"hiddens is \[\], but"),
    (told(hidden=64), r"hidden is 64, but .* \[16, 16\]"),
    (told(hidden=True), "hidden is True, but"),
    (told(hiddens="16, 16"), "hiddens is '16, 16', but"),
    (told(hiddens=[torch.ones(2), 16]), "hiddens is .* but"),
)


def test_content_that_is_no_network_is_refused(make_sequential, save):
    for spoil, match in BAD_CONTENT:
        path = save(spoil(dict(make_sequential(SCORE).state_dict())))
        with pytest.raises(FieldFileError, match=rf"net\.pth: {match}"):
            load_checkpoint(path, "score", activation=None if "activation" in match else "SiLU")
    content = {"state_dict": make_sequential([2, 2]).state_dict(), "hidden": 16}
    with pytest.raises(FieldFileError, match=r"hidden is 16, but the tensors have .* \[\]"):
        load_checkpoint(save(content), "tangent")


def test_damaged_and_other_files_are_refused(make_sequential, save, tmp_path):
    with pytest.raises(FieldFileError, match=r"absent\.pth: no such file"):
        load_checkpoint(tmp_path / "absent.pth", "score")
    with pytest.raises(FieldFileError, match="is a folder"):
        load_checkpoint(tmp_path, "score")
    state = make_sequential(SCORE).state_dict()
    save_file(state, tmp_path / "tensors")
    np.save(tmp_path / "array.npy", np.zeros((3, 2)))
    others = [(tmp_path / name).read_bytes() for name in ("tensors", "array.npy")]
    others.append(b"x,y\n1,2\n" * 20)
    for new in (True, False):
        path = save(state, _use_new_zipfile_serialization=new)
        whole = path.read_bytes()
        sizes = (0, 1, 10, len(whole) // 3, len(whole) * 9 // 10, len(whole) - 1)
        others += [whole[:size] for size in sizes]
    for data in others:
        path.write_bytes(data)
        with pytest.raises(FieldFileError, match=r"net\.pth: not a whole file of plain ten"):
            load_checkpoint(path, "score")


def test_random_damage_is_either_harmless_or_told(make_sequential, save):
    path = save(make_sequential(TANGENT).state_dict())
    whole = path.read_bytes()
    rng = np.random.default_rng(6)
    messages = []
    for _ in range(100):
        data = bytearray(whole)
        for position in rng.integers(len(whole), size=3):
            data[position] = rng.integers(256)
        path.write_bytes(data)
        try:
            load_checkpoint(path, "tangent")
        except FieldFileError as error:
            messages.append(str(error))
    assert all("net.pth: " in message and "\n" not in message for message in messages)
    assert len(messages) > 10


def test_nothing_is_unpickled(make_sequential, save, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    beside = {"state_dict": make_sequential(TANGENT).state_dict(), "notes": Trap()}
    for content, new in (
        (None, True),
        (Trap(), True),
        (Trap(), False),
        (nn.Sequential(nn.Linear(2, 2)), True),
        (beside, True),
    ):
        path = save(content, _use_new_zipfile_serialization=new)
        if content is None:
            path.write_bytes(pickle.dumps(Trap()))
        with pytest.raises(FieldFileError, match=r"net\.pth: .* nothing else is unpickled"):
            load_checkpoint(path, "tangent")
    assert os.listdir(tmp_path) == ["net.pth"]
