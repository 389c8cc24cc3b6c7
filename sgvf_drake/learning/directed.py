"""Learning a directed field: one network of (x, g) for the score and the tangent of strands."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from sgvf_drake.fields import FourierFeatures, Perceptron, StrandMixture, StrandNetwork
from sgvf_drake.learning.networks import POSITION_SCALE, Network
from sgvf_drake.learning.optimization import Optimization, optimize
from sgvf_drake.learning.score_matching import BOX_HALF_SIZE, Losses, compress
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    from sgvf_drake.learning.config import Settings

BATCH_SIZE = 512
LEARNING_RATE = 1.5e-2
WARMUP = 50
# Shares of a batch: uniform in the box; around a strand at four noise levels and not one;
# headed along a strand, give or take; of a shorter g, as while a heading turns round.
BOX_SHARE, WIDE_SHARE, WIDE = 0.2, 0.3, 4.0
ALONG_SHARE, ALONG_SPREAD = 0.6, 0.35
SHORT_SHARE = 0.2


class HeadingNetwork(nn.Module):
    """The torch twin of the network of a `StrandNetwork`: (x, g) -> (sigma S, N).

    Args:
        dim: d.
        hidden: Widths of the hidden layers.
        num_frequencies: Random Fourier features of the position.
        frequency_std: Their standard deviation, radians per unit of the scaled position.
        two_way: Whether S is even and N odd in g.
    """

    def __init__(
        self,
        dim: int,
        hidden: Sequence[int],
        num_frequencies: int,
        frequency_std: float,
        two_way: bool,
    ) -> None:
        super().__init__()
        self.two_way = two_way
        draw = frequency_std / POSITION_SCALE * torch.randn(num_frequencies, dim)
        self.register_buffer("frequencies", draw)
        # The layers behind the features, g among them, which enters the first one linearly.
        self.layers = Network(2 * num_frequencies + dim, hidden, 2 * dim)

    frequencies: Tensor

    def forward(self, x: Tensor, g: Tensor) -> Tensor:
        """Evaluates the network: (n, d), (n, d) -> (n, 2d)."""
        angles = x @ self.frequencies.T
        features = torch.cat([angles.sin(), angles.cos()], dim=1)
        output = self.layers(torch.cat([features, g], dim=1))
        if not self.two_way:
            return output
        mirrored = self.layers(torch.cat([features, -g], dim=1))
        d = g.shape[1]
        even = output[:, :d] + mirrored[:, :d]
        return torch.cat([even, output[:, d:] - mirrored[:, d:]], dim=1) / 2

    def to_perceptron(self) -> Perceptron:
        """Returns the same function in NumPy float64, of one sign of g."""
        layers = self.layers.to_perceptron()
        frequencies = self.frequencies.double().numpy().copy()
        passed = layers.num_inputs - 2 * len(frequencies)
        features = FourierFeatures(frequencies, np.zeros(len(frequencies)), passed)
        return Perceptron(layers.weights, layers.biases, features)


def strand_target(mixture: StrandMixture) -> Callable[[Tensor, Tensor], Tensor]:
    """The mixture in float32, (n, d), (n, d) -> (sigma S, N), (n, 2d), in few operations.

    A strand that is travelled either way is two that are travelled one way, of half the
    weight; and of the exponents, what all components have in common makes no difference.  So
    they are linear in x and g, and each step takes three operations of its whole size.
    """
    back = ~mixture.one_way
    points = np.concatenate([mixture.points, mixture.points[back]])
    directions = np.concatenate([mixture.directions, -mixture.directions[back]])
    sharpness = np.concatenate([mixture.sharpness, mixture.sharpness[back]])
    halved = np.where(np.concatenate([back, back[back]]), np.log(2), 0.0)
    square = mixture.sigma**2
    by_x_and_g = np.concatenate([points / square, sharpness[:, None] * directions], axis=1)
    offset = -(points**2).sum(axis=1) / (2 * square) - halved
    slopes, offsets, pulled = (
        torch.as_tensor(array, dtype=torch.float32)
        for array in (
            by_x_and_g.T,
            offset,
            np.concatenate([points / mixture.sigma, directions], axis=1),
        )
    )

    def target(x: Tensor, g: Tensor) -> Tensor:
        weights = torch.softmax(torch.addmm(offsets, torch.cat([x, g], dim=1), slopes), dim=1)
        means = weights @ pulled
        return torch.cat(
            [means[:, : x.shape[1]] - x / mixture.sigma, means[:, x.shape[1] :]], 1
        )

    return target


def strand_loss(network: HeadingNetwork, mixture: StrandMixture) -> Losses:
    """Regression on the mixture: compressed sigma S as in the robust score, and N.

    Positions lie around the strands and in the box, directions along the strands and
    anywhere in the unit ball.

    Args:
        network: What is trained.
        mixture: The exact strands, normalised units.
    """
    points, directions = (
        torch.as_tensor(array, dtype=torch.float32)
        for array in (mixture.points, mixture.directions)
    )
    sigma, d = mixture.sigma, points.shape[1]
    target = strand_target(mixture)

    def losses() -> dict[str, Tensor]:
        chosen = torch.randint(len(points), (BATCH_SIZE,))
        wide = torch.where(torch.rand(BATCH_SIZE, 1) < WIDE_SHARE, WIDE, 1.0)
        x = points[chosen] + sigma * wide * torch.randn(BATCH_SIZE, d)
        in_box = round(BOX_SHARE * BATCH_SIZE)
        x[:in_box] = BOX_HALF_SIZE * (2 * torch.rand(in_box, d) - 1)
        g = torch.randn(BATCH_SIZE, d)
        signs = torch.sign(torch.randn(BATCH_SIZE, 1))
        near = signs * directions[chosen] + ALONG_SPREAD * torch.randn(BATCH_SIZE, d)
        g = torch.where(torch.rand(BATCH_SIZE, 1) < ALONG_SHARE, near, g)
        g = nn.functional.normalize(g, dim=1)
        short = torch.rand(BATCH_SIZE, 1) < SHORT_SHARE
        g = torch.where(short, torch.rand(BATCH_SIZE, 1) * g, g)
        q, N = torch.split(target(x, g), d, dim=1)
        output = network(x, g)
        score = compress(output[:, :d]) - compress(q)
        return {
            "score": score.square().sum(dim=1).mean(),
            "tangent": (output[:, d:] - N).square().sum(dim=1).mean(),
        }

    return losses


def fit_strand_network(
    mixture: StrandMixture, settings: "Settings", progress: Progress
) -> tuple[StrandNetwork, pd.DataFrame]:
    """Learns a mixture of strands; returns the network and the history.

    Args:
        mixture: The exact strands, normalised units.
        settings: Those of the attempt; of networks and iterations the tangent's count.
        progress: Told how far the training is.
    """
    two_way = not mixture.one_way.any()
    network = HeadingNetwork(
        mixture.points.shape[1],
        settings.tangent_hidden,
        settings.num_frequencies,
        settings.frequency_std,
        two_way,
    )
    steps = Optimization(settings.tangent_iterations, LEARNING_RATE, WARMUP, cosine=True)
    history = optimize(network, strand_loss(network, mixture), steps, "strands", progress)
    return StrandNetwork(network.to_perceptron(), mixture.sigma, two_way), history
