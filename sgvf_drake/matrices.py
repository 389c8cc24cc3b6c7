"""Determinants and adjugates of small matrices, by minors, so that singular ones have them."""

from itertools import product

import numpy as np

from sgvf_drake.arrays import FloatArray


def determinant(J: FloatArray) -> FloatArray:
    """Returns the determinants of matrices, (n, d, d) -> (n,)."""
    return _expanded(J, -1.0)


def size_of_determinant(J: FloatArray) -> FloatArray:
    """Returns the sum of the sizes of what a determinant is the sum of, (n, d, d) -> (n,).

    What rounding changes of `determinant` is relative to it.
    """
    return _expanded(np.abs(J), 1.0)


def adjugate(J: FloatArray) -> FloatArray:
    """Returns the inverses of matrices times their determinants, (n, d, d); d is 2 or more."""
    found = np.empty(J.shape)
    for i, j in product(range(J.shape[1]), repeat=2):
        found[:, i, j] = (-1.0) ** (i + j) * determinant(_minor(J, j, i))
    return found


def _expanded(J: FloatArray, sign: float) -> FloatArray:
    """Returns the expansions of matrices along their first rows, with alternating signs."""
    if J.shape[1] == 1:
        return J[:, 0, 0]
    terms = [sign**j * J[:, 0, j] * _expanded(_minor(J, 0, j), sign) for j in range(J.shape[1])]
    return np.asarray(sum(terms))


def _minor(J: FloatArray, row: int, column: int) -> FloatArray:
    return np.delete(np.delete(J, row, axis=1), column, axis=2)
