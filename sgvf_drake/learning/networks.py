"""The networks that are trained: SiLU perceptrons, with or without Fourier features."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from sgvf_drake.fields import FourierFeatures, Perceptron
from sgvf_drake.fields.activation import SILU

# Random frequencies (Tancik et al. 2020) are drawn for inputs that were brought to about
# [-2, 2] and [-1, 1]: x / POSITION_SCALE and 2 t - 1.
POSITION_SCALE = 2.5


class Network(nn.Module):
    """A SiLU perceptron z -> outputs; the torch twin of `fields.Perceptron`.

    Args:
        num_inputs: Number of inputs; time, where there is one, is the last.
        hidden: Widths of the hidden layers.
        num_outputs: Number of outputs.
        num_frequencies: Random Fourier features of the scaled inputs, seen by the first
            layer; 0: none.
        frequency_std: Their standard deviation, radians per unit of the scaled input.
        has_time: Whether the last input is a diffusion time in [0, 1].
        scaled: Whether the first layer sees the scaled inputs where there are no features;
            else it sees z itself.
    """

    frequencies: Tensor
    phases: Tensor
    scale: Tensor
    offset: Tensor

    def __init__(
        self,
        num_inputs: int,
        hidden: Sequence[int],
        num_outputs: int,
        num_frequencies: int = 0,
        frequency_std: float = 1.0,
        has_time: bool = False,
        scaled: bool = False,
    ) -> None:
        super().__init__()
        self.has_features = num_frequencies > 0
        self.is_scaled = scaled and not self.has_features
        # 2 t - 1 is an affine input: its slope goes to Omega, its offset to the phase.
        scale = torch.full((num_inputs,), 1 / POSITION_SCALE)
        offset = torch.zeros(num_inputs)
        if has_time:
            scale[-1], offset[-1] = 2.0, -1.0
        draw = frequency_std * torch.randn(num_frequencies, num_inputs)
        self.register_buffer("frequencies", draw * scale)
        self.register_buffer("phases", draw @ offset)
        self.register_buffer("scale", scale)
        self.register_buffer("offset", offset)
        first = 2 * num_frequencies if self.has_features else num_inputs
        widths = [first, *hidden, num_outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))

    @classmethod
    def from_perceptron(cls, perceptron: Perceptron) -> "Network":
        """Returns the function of a perceptron of SiLU in torch, in float32."""
        assert perceptron.activation is SILU
        features = perceptron.features
        *hidden, num_outputs = map(len, perceptron.biases)
        num_frequencies = 0 if features is None else len(features.phases)
        # The initial weights, which are then replaced, have no part in any seed.
        with torch.random.fork_rng(devices=[]):
            network = cls(perceptron.num_inputs, hidden, num_outputs, num_frequencies)
        state: dict[str, np.ndarray] = {}
        if features is not None:
            state |= {"frequencies": features.frequencies, "phases": features.phases}
        for number, weight in enumerate(perceptron.weights):
            state[f"layers.{number}.weight"] = weight
            state[f"layers.{number}.bias"] = perceptron.biases[number]
        tensors = {key: torch.as_tensor(value) for key, value in state.items()}
        network.load_state_dict(network.state_dict() | tensors)
        return network

    def forward(self, z: Tensor) -> Tensor:
        """Evaluates the network: (n, inputs) -> (n, outputs)."""
        if self.has_features:
            angles = torch.addmm(self.phases, z, self.frequencies.T)
            z = torch.cat([angles.sin(), angles.cos()], dim=1)
        elif self.is_scaled:
            z = self.scale * z + self.offset
        for layer in self.layers[:-1]:
            z = nn.functional.silu(layer(z))
        return self.layers[-1](z)

    def to_perceptron(self) -> Perceptron:
        """Returns the same function in NumPy float64."""
        features = None
        if self.has_features:
            features = FourierFeatures(_numpy(self.frequencies), _numpy(self.phases))
        layers = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        weights = [_numpy(layer.weight) for layer in layers]
        biases = [_numpy(layer.bias) for layer in layers]
        if self.is_scaled:
            # The first layer is affine too, and takes the scaling in.
            biases[0] = biases[0] + weights[0] @ _numpy(self.offset)
            weights[0] = weights[0] * _numpy(self.scale)
        return Perceptron(tuple(weights), tuple(biases), features)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().numpy().copy()
