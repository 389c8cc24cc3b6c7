"""Zeros by SciPy from every cell of a fine grid: what a search is held against."""

import numpy as np
from scipy.optimize import root


def dense_zeros(field, box, cells, flat=0.0):
    """Roots from every cell in which neither component of a field keeps its sign, (n, 2).

    Left out are those in a valley: where the singular values of the Jacobian are farther apart
    than by the factor `flat`.
    """
    axes = [np.linspace(box[0][k], box[1][k], cells + 1) for k in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = field(grid.reshape(-1, 2)).reshape(grid.shape)
    corners = np.stack([values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]])
    crossing = (np.sign(corners).min(axis=0) != np.sign(corners).max(axis=0)).all(axis=-1)
    half = (box[1] - box[0]) / cells / 2
    roots = []
    for start in grid[:-1, :-1][crossing] + half:
        # In cells, so that one tolerance serves every unit of length.
        found = root(
            lambda u, x=start: field(x + u * half),
            np.zeros(2),
            jac=lambda u, x=start: field.value_and_jacobian(x + u * half)[1] * half,
            tol=1e-12,
        )
        x = start + found.x * half
        singular = np.linalg.svd(field.value_and_jacobian(x)[1] * half, compute_uv=False)
        inside = ((x >= box[0]) & (x <= box[1])).all()
        small = np.linalg.norm(found.fun) < 1e-6 * singular[0]
        if small and inside and singular[1] > flat * singular[0]:
            roots.append(x)
    return np.array(roots).reshape(-1, 2)
