"""Networks that plain torch trained, imported and certified by the commands.

The field is brought in by its files alone, as from anyone.
"""

from itertools import pairwise

import pytest
import torch
from torch import nn

from sgvf_drake import load_field
from sgvf_drake.certificate import Certificate
from sgvf_drake.cli import main

RADIUS, NOISE, BATCH = 3.0, 0.3, 256


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


def run(*arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0


@pytest.mark.full
def test_what_was_trained_elsewhere_is_certified(tmp_path):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        score, tangent = perceptron(3, 32, 32, 2), perceptron(2, 16, 16, 2)
        fit(score, denoising, 700)
        fit(tangent, along, 300)
    files = {"--score": tmp_path / "score.pth", "--tangent": tmp_path / "tangent.pth"}
    torch.save(score.state_dict(), files["--score"])
    torch.save(tangent.state_dict(), files["--tangent"])
    options = [part for option in files.items() for part in option]
    assert run("import", *options, "--activation", "SiLU", "--out", tmp_path / "imported") == 0
    file, out = tmp_path / "imported" / "field.safetensors", tmp_path / "certificate"
    assert run("certify", file, "--out", out) == 0
    field, found = load_field(file), Certificate.load(out / "certificate.json")
    assert (field.recipe, field.tangent_network.activation.name) == ("imported", "SiLU")
    assert found.certified
    (piece,) = found.pieces
    assert piece.orbit_exists
    assert piece.orbit_unique
    assert piece.lap_time_low < piece.lap_time_high
    # Two walls on either side are proved of these, and so a fifth of the box.
    assert found.area_fraction > 0.2
    assert len(found.walls[0]) >= 2
    assert found.orbit_half_width < RADIUS / 3
    assert found.counterexample is None
