"""A multi-layer perceptron evaluated in NumPy, with its exact Jacobian; one that is a score."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sgvf_drake.fields.activation import SILU, Activation
from sgvf_drake.fields.base import FloatArray


@dataclass(frozen=True, eq=False)
class FourierFeatures:
    """The map (z, g) -> [sin(Omega z + phi), cos(Omega z + phi), g].

    Attributes:
        frequencies: Omega, (F, size of z), radians per unit of the input.
        phases: phi, (F,), radians.
        passed: The size of g, further inputs that are passed on as they are.
    """

    frequencies: FloatArray
    phases: FloatArray
    passed: int = 0

    @property
    def num_inputs(self) -> int:
        """The number of all inputs."""
        return int(self.frequencies.shape[1]) + self.passed

    @property
    def num_outputs(self) -> int:
        """The number of all features."""
        return 2 * len(self.phases) + self.passed

    def jet(self, inputs: FloatArray) -> FloatArray:
        """Returns the features and their derivatives, (n, 1 + inputs, features)."""
        F, d = self.frequencies.shape
        angles = inputs[:, :d] @ self.frequencies.T + self.phases
        sine, cosine = np.sin(angles), np.cos(angles)
        jet = np.zeros((len(inputs), 1 + self.num_inputs, self.num_outputs), angles.dtype)
        jet[:, 0, :F], jet[:, 0, F : 2 * F], jet[:, 0, 2 * F :] = sine, cosine, inputs[:, d:]
        jet[:, 1 : 1 + d, :F] = cosine[:, None, :] * self.frequencies.T
        jet[:, 1 : 1 + d, F : 2 * F] = -sine[:, None, :] * self.frequencies.T
        jet[:, 1 + d :, 2 * F :] = np.eye(self.passed)
        return jet

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Returns the features: (n, inputs) -> (n, features)."""
        d = self.frequencies.shape[1]
        angles = inputs[:, :d] @ self.frequencies.T + self.phases
        return np.concatenate([np.sin(angles), np.cos(angles), inputs[:, d:]], axis=1)


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
        if self.features is None:
            return int(self.weights[0].shape[1])
        return self.features.num_inputs

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
