"""A guiding field whose value, Jacobian and Hessian are known in closed form."""

import numpy as np
import pytest
import sympy


class CircleField:
    """A guiding field of unit length around the unit circle, counter-clockwise.

    The direction is the unit tangent plus `gain` times (1 - r) radially, normalised.  In
    three dimensions the circle lies in the plane z = 1 and `gain` also pulls to that plane.
    The derivatives are SymPy's, so they are exact and owe nothing to the code under test.
    """

    def __init__(self, dim: int = 2, gain: float = 3.0) -> None:
        self.dim = dim
        self.calls = 0
        p = sympy.symbols("x y z")[:dim]
        x, y = p[0], p[1]
        r = sympy.sqrt(x**2 + y**2)
        direction = [(-y + gain * (1 - r) * x) / r, (x + gain * (1 - r) * y) / r]
        if dim == 3:
            direction.append(gain * (1 - p[2]))
        length = sympy.sqrt(sum(c**2 for c in direction))
        m = [c / length for c in direction]
        J = [[sympy.diff(c, s) for s in p] for c in m]
        H = [[[sympy.diff(c, s) for s in p] for c in row] for row in J]
        self._m = sympy.lambdify(p, m, "math", cse=True)
        self._m_J = sympy.lambdify(p, [m, J], "math", cse=True)
        self._H = sympy.lambdify(p, H, "math", cse=True)

    def _map(self, function, x, shape):
        self.calls += 1
        assert x.dtype == np.float64, "the field must never see objects"
        if x.ndim == 1:
            return np.array(function(*x.tolist()))
        return np.array([function(*row) for row in x.tolist()]).reshape(len(x), *shape)

    def __call__(self, x):
        return self._map(self._m, x, (self.dim,))

    def value_and_jacobian(self, x):
        self.calls += 1
        assert x.dtype == np.float64, "the field must never see objects"
        if x.ndim == 1:
            m, J = self._m_J(*x.tolist())
            return np.array(m), np.array(J)
        pairs = [self._m_J(*row) for row in x.tolist()]
        return np.array([m for m, _ in pairs]), np.array([J for _, J in pairs])

    def hessian(self, x):
        return self._map(self._H, x, (self.dim,) * 3)


@pytest.fixture(scope="session")
def circle_field():
    """The planar field."""
    return CircleField(dim=2)


@pytest.fixture(scope="session")
def spatial_circle_field():
    """The field in three dimensions."""
    return CircleField(dim=3)
