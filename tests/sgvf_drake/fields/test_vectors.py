"""Angles between vectors, and the part of a Jacobian that no gradient has."""

import numpy as np

from sgvf_drake.fields.vectors import cosine, curl_share


def test_cosines():
    a = np.array([[1.0, 0.0], [0.0, 0.0], [3.0, 4.0]])
    b = np.array([[1.0, 1.0], [1.0, 0.0], [-3.0, -4.0]])
    np.testing.assert_allclose(cosine(a, b), [np.sqrt(0.5), 0.0, -1.0])


def test_a_gradient_has_no_curl_and_a_rotation_nothing_else():
    symmetric = np.array([[2.0, 1.0], [1.0, -3.0]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    shares = curl_share(np.stack([symmetric, 5 * turn, symmetric + turn]))
    # Of the last, the parts are orthogonal: |turn| / sqrt(|symmetric|^2 + |turn|^2).
    both = np.sqrt(2) / np.sqrt(4 + 1 + 1 + 9 + 2)
    np.testing.assert_allclose(shares, [0.0, np.sqrt(2), np.sqrt(2) * both])
