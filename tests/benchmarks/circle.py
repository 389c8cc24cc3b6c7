"""A field that costs next to nothing and is known in closed form."""

import numpy as np


class Circle:
    """A field of length one around the unit circle, counter-clockwise.

    With the direction from the centre n, the tangent t and z = gain (1 - r), it is
    (z n + t) / sqrt(1 + z^2).
    """

    dim = 2

    def __init__(self, gain=2.0):
        self._gain = gain

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        r = np.hypot(*x)
        n = x / r
        t = np.array([-n[1], n[0]])
        z = self._gain * (1.0 - r)
        c = 1.0 / np.sqrt(1.0 + z * z)
        s = z * c
        return s * n + c * t, np.outer(s * t - c * n, self._gain * c * c * n + t / r)

    def hessian(self, x):
        raise NotImplementedError
