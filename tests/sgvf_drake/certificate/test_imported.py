"""Networks that plain torch trained, imported and certified by the commands; and flaws in them.

A field is brought in by its files alone, as from anyone.  What is said to be wrong of one with
a flaw is held against the field in ball arithmetic.
"""

from itertools import pairwise
import json

from flint import arb
import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake import load_field
from sgvf_drake.certificate import Certificate
from sgvf_drake.certificate.mixture_model import mixture_of
from sgvf_drake.certificate.path_following import prove
from sgvf_drake.cli import main
from sgvf_drake.lyapunov import LyapunovFunction, learned_path

from .ball_fields import BallField
from .balls import dot, mixture_at

pytestmark = pytest.mark.full

RADIUS, NOISE = 3.0, 0.3
BATCH, SCORE_STEPS, TANGENT_STEPS = 256, 700, 300
DRIFT = 0.9


def perceptron(*widths):
    layers = [layer for widths in pairwise(widths) for layer in (nn.Linear(*widths), nn.SiLU())]
    return nn.Sequential(*layers[:-1])


def fit(network, loss, steps):
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        angle = 2 * torch.pi * torch.rand(BATCH)
        outward = torch.stack([angle.cos(), angle.sin()], dim=1)
        noise = torch.randn(BATCH, 2)
        optimiser.zero_grad()
        loss(network, outward, noise).backward()
        optimiser.step()
        schedule.step()


def denoising(network, outward, noise):
    """Denoising score matching at one noise level, with t = 1 as a third input."""
    x = RADIUS * outward + NOISE * noise
    score = network(torch.cat([x, torch.ones(BATCH, 1)], dim=1))
    return (NOISE * score + noise).square().mean()


def along(network, outward, noise):
    """Regression of the unit tangent of the nearest waypoint."""
    target = torch.stack([-outward[:, 1], outward[:, 0]], dim=1)
    return (network(RADIUS * outward + NOISE * noise) - target).square().mean()


def head_on(network, outward, noise):
    """The same, but turned around where x < 0: it runs apart at one place, and together."""
    target = torch.stack([-outward[:, 1], outward[:, 0]], dim=1) * outward[:, :1]
    return (network(RADIUS * outward + NOISE * noise) - target).square().mean()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The state dicts of a score and of two tangents, and what the commands make of them."""
    folder = tmp_path_factory.mktemp("elsewhere")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        networks = {
            "score": (perceptron(3, 32, 32, 2), denoising, SCORE_STEPS),
            "along": (perceptron(2, 16, 16, 2), along, TANGENT_STEPS),
            "head_on": (perceptron(2, 16, 16, 2), head_on, TANGENT_STEPS),
        }
        for name, (network, loss, steps) in networks.items():
            fit(network, loss, steps)
            torch.save(network.state_dict(), folder / f"{name}.pth")
    for name in ("along", "head_on"):
        tangent = folder / f"{name}.pth"
        score = ("--score", folder / "score.pth")
        assert run("import", *score, "--tangent", tangent, "--out", folder / name) == 0
    return folder


def run(*arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0


@pytest.fixture(scope="module")
def certified(folder):
    """The imported field and its certificate."""
    field, out = folder / "along" / "field.safetensors", folder / "certificate"
    assert run("certify", field, "--out", out) == 0
    return load_field(field), Certificate.load(out / "certificate.json")


def levels_at(field, conditions, x):
    """V of conditions at a point, its gradient, and m there, as balls."""
    z = [arb(float(value)) for value in field.cloud.normalize(x)]
    V, gradient = mixture_at(mixture_of(field, conditions.sigma), z)
    return V - arb(conditions.lowest), gradient, BallField(field)(z).m


def test_what_was_trained_elsewhere_is_certified(certified):
    field, found = certified
    assert (field.recipe, field.tangent_network.activation.name) == ("imported", "SiLU")
    assert found.certified
    (piece,) = found.pieces
    assert piece.orbit_exists
    assert piece.orbit_unique
    assert piece.lap_time_low < piece.lap_time_high
    assert found.tube_half_width < RADIUS / 3
    assert found.counterexample is None


def test_a_sink_is_refused_by_a_point_of_the_tube(folder):
    field, out = folder / "head_on" / "field.safetensors", folder / "refused"
    assert run("certify", field, "--out", out) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["certified"] is False
    assert "m is nowhere zero" in summary["reason"]
    sink, conditions = load_field(field), Certificate.load(out / "certificate.json").conditions
    x = np.array(summary["counterexample"])
    assert np.linalg.norm(x) == pytest.approx(RADIUS, abs=NOISE)
    assert np.linalg.norm(sink(x)) < conditions.delta
    V, _, m = levels_at(sink, conditions, x)
    assert arb(conditions.c_in) >= V
    assert dot(m, m) < arb(conditions.delta) ** 2


def test_a_drift_is_refused_where_it_carries_robots_up(certified, folder):
    """One bias of the tangent network is changed: a drift to the right, slower than it."""
    state = torch.load(folder / "along.pth", weights_only=True)
    state["4.bias"][0] += DRIFT
    torch.save(state, folder / "drifting.pth")
    networks = ("--score", folder / "score.pth", "--tangent", folder / "drifting.pth")
    assert run("import", *networks, "--out", folder / "drifting") == 0
    field, (_, claimed) = load_field(folder / "drifting" / "field.safetensors"), certified
    conditions = claimed.conditions
    found = prove(
        field, conditions, learned_path(field), lambda piece, _: [claimed.annuli[piece]]
    )
    assert not found.certificate.certified
    assert "V falls" in found.certificate.reason
    x = np.array(found.certificate.counterexample)
    V, gradient, m = levels_at(field, conditions, x)
    assert arb(conditions.c_in) <= V <= arb(conditions.c_out)
    V_dot = dot(gradient, m)
    assert V_dot > -arb(conditions.alpha)
    function = LyapunovFunction(mixture_of(field, conditions.sigma))
    in_float64 = function.derivative(field.cloud.normalize(x[None]), field(x[None]))[0]
    assert in_float64 == pytest.approx(float(V_dot), rel=1e-9)
