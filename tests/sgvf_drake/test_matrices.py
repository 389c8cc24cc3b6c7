"""Small matrices: determinants and adjugates against NumPy, of singular ones too."""

import numpy as np
import pytest

from sgvf_drake.matrices import adjugate, determinant, size_of_determinant


@pytest.mark.parametrize("dim", [2, 3, 4])
def test_they_are_those_of_numpy(dim):
    J = np.random.default_rng(dim).standard_normal((50, dim, dim))
    # The last column of half of them is the sum of the others: of rank d - 1.
    J[::2, :, -1] = J[::2, :, :-1].sum(axis=2)
    assert np.allclose(determinant(J), np.linalg.det(J))
    assert np.allclose(adjugate(J) @ J, determinant(J)[:, None, None] * np.eye(dim))
    assert np.linalg.matrix_rank(adjugate(J)).tolist() == [1, dim] * 25
    assert (size_of_determinant(J) >= np.abs(determinant(J))).all()
    assert size_of_determinant(-np.abs(J)) == pytest.approx(size_of_determinant(J))
