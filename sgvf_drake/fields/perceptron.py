"""A multi-layer perceptron evaluated in NumPy, with its exact Jacobian."""

from dataclasses import dataclass, replace

import numpy as np

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

    def value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the features (n, 2F) and their derivatives (n, inputs, 2F)."""
        angles = z @ self.frequencies.T + self.phases
        sine, cosine = np.sin(angles), np.cos(angles)
        slopes = np.concatenate([cosine, -sine], axis=1)
        directions = np.concatenate([self.frequencies, self.frequencies]).T
        return np.concatenate([sine, cosine], axis=1), slopes[:, None, :] * directions

    def __call__(self, z: FloatArray) -> FloatArray:
        """Returns the features: (n, inputs) -> (n, 2F)."""
        angles = z @ self.frequencies.T + self.phases
        return np.concatenate([np.sin(angles), np.cos(angles)], axis=1)


@dataclass(frozen=True, eq=False)
class Perceptron:
    """A SiLU network z -> W_L silu(... silu(W_1 features(z) + b_1)) + b_L.

    Attributes:
        weights: W_l of shape (outputs, inputs), first layer first.
        biases: b_l of shape (outputs,).
        features: What the first layer sees; None: z itself.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    features: FourierFeatures | None = None

    @property
    def num_inputs(self) -> int:
        """The number of inputs."""
        first = self.weights[0] if self.features is None else self.features.frequencies
        return int(first.shape[1])

    def __call__(self, z: FloatArray) -> FloatArray:
        """Evaluates the network: (n, inputs) -> (n, outputs)."""
        hidden = z if self.features is None else self.features(z)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = hidden @ weight.T + bias
            hidden = hidden * _sigmoid(hidden)
        return hidden @ self.weights[-1].T + self.biases[-1]

    def value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the outputs (n, outputs) and d outputs / d z (n, outputs, inputs).

        The derivatives ride along with the values, one column for each input (forward
        mode): cheaper than a backward pass where inputs are as few as outputs.
        """
        if self.features is None:
            hidden = z
            tangents = np.broadcast_to(np.eye(z.shape[1]), (len(z), z.shape[1], z.shape[1]))
        else:
            hidden, tangents = self.features.value_and_jacobian(z)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            before = hidden @ weight.T + bias
            gate = _sigmoid(before)
            hidden = before * gate
            slope = gate + hidden * (1 - gate)
            tangents = (tangents @ weight.T) * slope[:, None, :]
        outputs = hidden @ self.weights[-1].T + self.biases[-1]
        return outputs, np.swapaxes(tangents @ self.weights[-1].T, 1, 2)

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


def _sigmoid(z: FloatArray) -> FloatArray:
    # Clipping the real part keeps exp finite; beyond it the value is 0 or 1 to the last bit.
    if np.iscomplexobj(z):
        return 1 / (1 + np.exp(-(np.clip(z.real, -700, 700) + 1j * z.imag)))
    return 1 / (1 + np.exp(-np.clip(z, -700, 700)))
