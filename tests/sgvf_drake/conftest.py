"""Networks in torch, as others train them, and the paper's field as torch evaluates it."""

import copy
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake.lyapunov import samples

# Of the trained ring: its radius, and the noise level of its score.
RADIUS, RING_SIGMA = 3.0, 0.3


def sequential(widths, activation="SiLU", seed=0, dtype=torch.float32):
    """An untrained perceptron in the form that most people write it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [
            layer
            for inputs, outputs in pairwise(widths)
            for layer in (nn.Linear(inputs, outputs), getattr(nn, activation)())
        ]
    return nn.Sequential(*layers[:-1]).to(dtype)


def papers_field(score, tangent, gain=0.2, normalise=False):
    """m(x) = tanh(k_s |S|) S / |S| + v(x) at t = 1 in torch, in float64 and the unit of x."""
    score, tangent = copy.deepcopy(score).double(), copy.deepcopy(tangent).double()

    def m(x):
        S = score(torch.cat([x, torch.ones_like(x[..., :1])], dim=-1))
        size = S.norm(dim=-1, keepdim=True)
        value = torch.tanh(gain * size) * S / size + tangent(x)
        return value / value.norm(dim=-1, keepdim=True) if normalise else value

    return m


def ring_score():
    """A score that falls by 1 / sigma^2 across a circle; its last layer is fitted exactly.

    S = -x (|x|^2 - R^2) / (2 R^2 sigma^2) is a cubic, which 200 random neurons span.
    """
    network = sequential([3, 200, 2], "Tanh", dtype=torch.float64)
    rng = np.random.default_rng(0)
    with torch.no_grad():
        network[0].weight.copy_(torch.as_tensor(0.3 * rng.standard_normal((200, 3))))
        network[0].bias.copy_(torch.as_tensor(rng.uniform(-1.5, 1.5, 200)))
        side = torch.linspace(-5.5, 5.5, 40, dtype=torch.float64)
        x = torch.cartesian_prod(side, side)
        hidden = network[:2](torch.cat([x, torch.ones(len(x), 1)], dim=1))
        excess = (x**2).sum(dim=1, keepdim=True) - RADIUS**2
        S = -x * excess / (2 * RADIUS**2 * RING_SIGMA**2)
        design = torch.cat([hidden, torch.ones(len(x), 1)], dim=1)
        fitted = torch.linalg.lstsq(design, S, driver="gelsd").solution
        network[2].weight.copy_(fitted[:-1].T)
        network[2].bias.copy_(fitted[-1])
    return network


def ring_tangent():
    """A quarter turn of x / R: of length one on the circle, counter-clockwise."""
    network = sequential([2, 2], dtype=torch.float64)
    with torch.no_grad():
        network[0].weight.copy_(torch.tensor([[0.0, -1.0], [1.0, 0.0]]) / RADIUS)
        network[0].bias.zero_()
    return network


@pytest.fixture(scope="module")
def coarse_grid():
    """Verifies on a sixth of the samples: what lies between them is found by searches."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(samples.GRID_SIZES, 2, 121)
        yield


@pytest.fixture(scope="session")
def make_sequential():
    """Makes untrained networks; see `sequential`."""
    return sequential


@pytest.fixture(scope="session")
def field_in_torch():
    """Makes the paper's field of two networks, from tensors to tensors; see `papers_field`."""
    return papers_field


@pytest.fixture(scope="session")
def largest_difference():
    """How far a field is from the paper's field in torch, over the box of its cloud."""

    def measure(field, score, tangent, gain=0.2, normalise=False):
        x = np.random.default_rng(7).uniform(*field.cloud.box, (400, field.dim))
        with torch.no_grad():
            expected = papers_field(score, tangent, gain, normalise)(torch.as_tensor(x))
        return np.abs(field(x) - expected.numpy()).max()

    return measure


@pytest.fixture(scope="session")
def ring_networks():
    """A score and a tangent that lap a circle of radius 3 counter-clockwise."""
    return ring_score(), ring_tangent()
