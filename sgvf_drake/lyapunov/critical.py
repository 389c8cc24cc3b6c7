"""The critical points of V, at which it falls along no field."""

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import FloatArray
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples

# Newton steps from the smallest gradients of the grid to the critical points of V, where
# |grad V| sigma is below the second number; Hessians of a smaller determinant, times
# sigma^4, are singular.
NEWTON_STEPS = 20
CRITICAL = 1e-6
SINGULAR = 1e-12


def critical_levels(
    function: LyapunovFunction, samples: Samples, slope: FloatArray
) -> FloatArray:
    """Returns the levels of the critical points of V in the box, at which V_dot is zero.

    They are found from the local minima of |grad V| on the grid by Newton's method; V falls
    fast so near to them that samples miss them.

    Args:
        function: V.
        samples: Whose grid is searched.
        slope: |grad V| on that grid, (ky, kx).
    """
    lowest = slope == ndimage.minimum_filter(slope, size=3)
    x = samples.x[samples.on_grid][lowest.ravel()]
    for _ in range(NEWTON_STEPS):
        gradient, hessian = function.gradient_and_hessian(x)
        regular = np.abs(np.linalg.det(hessian)) > SINGULAR / function.sigma**4
        x, gradient, hessian = x[regular], gradient[regular], hessian[regular]
        x = x - np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
    found = np.linalg.norm(function.gradient(x), axis=1) < CRITICAL / function.sigma
    lower, upper = samples.corners
    inside = ((lower <= x) & (x <= upper)).all(axis=1)
    return function(x[found & inside])
