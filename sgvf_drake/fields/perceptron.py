"""A multi-layer perceptron evaluated in NumPy, with its exact Jacobian; one that is a score."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sgvf_drake.fields.activation import SILU, Activation
from sgvf_drake.fields.base import FloatArray


@dataclass(frozen=True, eq=False)
class FourierFeatures:
    """The map z -> [sin(Omega z + phi), cos(Omega z + phi)].

    Attributes:
        frequencies: Omega, (F, inputs), radians per unit of the input.
        phases: phi, (F,), radians.
    """

    frequencies: FloatArray
    phases: FloatArray

    def jet(self, z: FloatArray) -> FloatArray:
        """Returns the features and their derivatives by each input, (n, 1 + inputs, 2F)."""
        angles = z @ self.frequencies.T + self.phases
        sine, cosine = np.sin(angles), np.cos(angles)
        F = len(self.phases)
        jet = np.empty((len(z), 1 + z.shape[1], 2 * F), angles.dtype)
        jet[:, 0, :F], jet[:, 0, F:] = sine, cosine
        jet[:, 1:, :F] = cosine[:, None, :] * self.frequencies.T
        jet[:, 1:, F:] = -sine[:, None, :] * self.frequencies.T
        return jet

    def __call__(self, z: FloatArray) -> FloatArray:
        """Returns the features: (n, inputs) -> (n, 2F)."""
        angles = z @ self.frequencies.T + self.phases
        return np.concatenate([np.sin(angles), np.cos(angles)], axis=1)


@dataclass(frozen=True, eq=False)
class Perceptron:
    """A network z -> W_L h(... h(W_1 features(z) + b_1)) + b_L with an activation h.

    Attributes:
        weights: W_l of shape (outputs, inputs), first layer first.
        biases: b_l of shape (outputs,).
        features: What the first layer sees; None: z itself.
        activation: h, the same after every layer but the last.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    features: FourierFeatures | None = None
    activation: Activation = SILU

    @property
    def num_inputs(self) -> int:
        """The number of inputs."""
        first = self.weights[0] if self.features is None else self.features.frequencies
        return int(first.shape[1])

    def __call__(self, z: FloatArray) -> FloatArray:
        """Evaluates the network: (n, inputs) -> (n, outputs)."""
        hidden = z if self.features is None else self.features(z)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = self.activation.value(hidden @ weight.T + bias)
        return hidden @ self.weights[-1].T + self.biases[-1]

    def value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the outputs (n, outputs) and d outputs / d z (n, outputs, inputs).

        The derivatives ride along with the values, one column for each input (forward
        mode): cheaper than a backward pass where inputs are as few as outputs.
        """
        # Rows of a jet: the value, then its derivative by each input.  One product a layer.
        if self.features is None:
            slopes = np.broadcast_to(np.eye(z.shape[1]), (*z.shape, z.shape[1]))
            jet = np.concatenate([z[:, None, :], slopes], axis=1)
        else:
            jet = self.features.jet(z)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            jet = jet @ weight.T
            value, slope = self.activation.value_and_slope(jet[:, 0] + bias)
            jet *= slope[:, None, :]
            jet[:, 0] = value
        jet = jet @ self.weights[-1].T
        return jet[:, 0] + self.biases[-1], np.swapaxes(jet[:, 1:], 1, 2)

    def with_last_input(self, value: float) -> "Perceptron":
        """Returns the network of the other inputs, the last one held at `value`."""
        if self.features is None:
            first = self.weights[0]
            bias = self.biases[0] + first[:, -1] * value
            weights, biases = (first[:, :-1], *self.weights[1:]), (bias, *self.biases[1:])
            return replace(self, weights=weights, biases=biases)
        frequencies = self.features.frequencies
        phases = self.features.phases + frequencies[:, -1] * value
        return replace(self, features=FourierFeatures(frequencies[:, :-1], phases))


@dataclass(frozen=True, eq=False)
class ScoreNetwork:
    """A network of (x, t) that gives `scale` times the score at time t.

    Attributes:
        network: d + 1 inputs (x in normalised units, t in [0, 1]), d outputs.
        scale: What divides the outputs at t = 1 to make the score: sigma where the network
            was trained on q = sigma S, 1 where it was trained on S itself.
    """

    network: Perceptron
    scale: float

    @cached_property
    def _at_data_end(self) -> Perceptron:
        return self.network.with_last_input(1.0)

    def score(self, x: FloatArray) -> FloatArray:
        """Returns S(x, t = 1): (n, d) -> (n, d)."""
        return self._at_data_end(x) / self.scale

    def score_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns S(x, t = 1), (n, d), and its Jacobian, (n, d, d)."""
        output, jacobian = self._at_data_end.value_and_jacobian(x)
        return output / self.scale, jacobian / self.scale
