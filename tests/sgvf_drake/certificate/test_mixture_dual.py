"""Derivatives of the score of a mixture over squares, held against ball arithmetic."""

from flint import arb
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.mixture_model import dual_mixture
from sgvf_drake.fields import GaussianMixture

from .balls import dot, model_at, vector


def slopes_at(mixture, z):
    """dS_m / dz_k of a mixture as balls, by k and m."""
    variance = arb(mixture.sigma) ** 2
    offsets = [[a - b for a, b in zip(vector(x), z, strict=True)] for x in mixture.points]
    weights = [(-dot(y, y) / (2 * variance)).exp() for y in offsets]
    total = sum(weights, arb(0))
    means = [dot(weights, [y[k] for y in offsets]) / total for k in range(2)]

    def covariance(k, m):
        products = [(y[k] - means[k]) * (y[m] - means[m]) for y in offsets]
        return dot(weights, products) / total

    return [
        [covariance(k, m) / variance**2 - (k == m) / variance for m in range(2)]
        for k in range(2)
    ]


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    half=st.integers(-45, 0).map(lambda exponent: 2.0**exponent),
    sigma=st.sampled_from([0.05, 0.3, 2.0]),
)
def test_derivatives_of_a_mixture_are_inside_of_their_models(seed, half, sigma):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture(
        rng.uniform(-3, 3, (int(rng.choice([1, 2, 2, 3, 5, 8])), 2)), sigma
    )
    center = rng.uniform(-4, 4, 2)
    if len(mixture.points) == 2:
        # About as far from one as from the other, where weights change most and are off most.
        first, last = mixture.points
        apart = last - first
        center = (first + last) / 2 + rng.uniform(-9, 9) * apart[::-1] * [-1, 1]
        center += rng.uniform(-3, 3) * sigma**2 * apart / (apart**2).sum()
    boxes = Boxes(center[None], np.array([half]))
    with np.errstate(over="ignore", invalid="ignore"):
        models = dual_mixture(mixture, boxes)
    corners = [[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]
    for d in half * np.concatenate([corners, rng.uniform(-1, 1, (3, 2))]):
        z = [arb(float(c)) + arb(float(x)) for c, x in zip(boxes.centers[0], d, strict=True)]
        slopes = slopes_at(mixture, z)
        for k, model in enumerate(models.slopes):
            # On squares that are too large to say anything, the models say so.
            if np.isfinite(model.remainder).all():
                for m in range(2):
                    polynomial, remainder = model_at(model, 0, m, d)
                    assert abs(slopes[k][m] - polynomial) <= remainder


def test_what_is_left_falls_with_the_cube_of_the_square():
    rng = np.random.default_rng(1)
    mixture = GaussianMixture(rng.uniform(-3, 3, (40, 2)), 0.3)
    centers = rng.uniform(-3, 3, (50, 2))
    remainders = [
        np.median([slope.remainder for slope in dual_mixture(mixture, boxes).slopes])
        for boxes in (Boxes(centers, np.full(50, 2.0**-exponent)) for exponent in (10, 11))
    ]
    assert remainders[0] / remainders[1] == pytest.approx(8, rel=0.1)
