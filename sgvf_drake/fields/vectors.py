"""What two fields, or a field and its Jacobian, are compared by."""

import numpy as np

from sgvf_drake.arrays import FloatArray


def cosine(a: FloatArray, b: FloatArray) -> FloatArray:
    """Returns the cosines between vectors, (n, d), (n, d) -> (n,).

    Where one of them is zero there is no angle; it counts as a right one.
    """
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray((a * b).sum(axis=1) / np.maximum(norms, np.finfo(np.float64).tiny))


def component_along(direction: FloatArray, a: FloatArray) -> FloatArray:
    """Returns the component of vectors along others, (n, d), (n, d) -> (n,)."""
    norm = np.maximum(np.linalg.norm(direction, axis=1), np.finfo(np.float64).tiny)
    return np.asarray((direction * a).sum(axis=1) / norm)


def curl_share(jacobian: FloatArray) -> FloatArray:
    """Returns the curl over the size of Jacobians, |J - J^T| / sqrt(2) |J|, (n, d, d) -> (n,).

    A gradient has none, a rotation the square root of two; in the plane this is
    |dS_x/dy - dS_y/dx| / |J|.
    """
    turning = np.linalg.norm(jacobian - np.swapaxes(jacobian, 1, 2), axis=(1, 2)) / np.sqrt(2)
    return np.asarray(turning / np.linalg.norm(jacobian, axis=(1, 2)))
