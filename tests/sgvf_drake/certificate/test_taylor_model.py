"""The arithmetic of Taylor models: whatever they stand for, the result stands for its value.

A function that a model stands for is its polynomial plus a share, between -1 and 1, of its
remainder; a different one at every step.
"""

from itertools import product

from flint import arb
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import (
    DECAY,
    FALL,
    INVERSE_ROOT,
    SECH_OF_ROOT,
    SINE,
    SQUASH,
)
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel

from .balls import FUNCTIONS, OF_A_SQUARE, corners, divided, model_at

parameters = st.integers(0, 3)
scales = st.integers(-12, 6).map(lambda exponent: 10.0**exponent)
seeds = st.integers(0, 2**32 - 1)


def random_model(rng, scale, k, functions=2, patches=1):
    """Models whose parts are zero, small or large, of any sign."""

    def part(*shape):
        kind = rng.choice([0.0, 1e-6, 1.0, 30.0], size=shape)
        return scale * kind * rng.standard_normal(shape)

    rows = 1 + k + k * (k + 1) // 2
    return TaylorModel(part(patches, rows, functions), np.abs(part(patches, functions)))


def steps(rng, k):
    """Parameters of the corners, the middles of the sides, the centre, and at random."""
    return np.concatenate([corners(k), rng.uniform(-1, 1, (6, k))])


def stands_for(model, rng, u):
    """Values of functions that a model stands for, at parameters u: the extremes among them."""
    values = []
    for column in range(model.value.shape[1]):
        polynomial, remainder = model_at(model, 0, column, u)
        values.append(
            polynomial + remainder * float(rng.choice([-1, 0, 1, rng.uniform(-1, 1)]))
        )
    return values


def assert_holds(model, column, u, value):
    polynomial, remainder = model_at(model, 0, column, u)
    assert abs(value - polynomial) <= remainder
    assert arb(float(model.lower[0, column])) <= value
    assert value <= arb(float(model.upper[0, column]))
    assert abs(value) <= arb(float(model.magnitude[0, column]))


@settings(max_examples=80)
@given(seed=seeds, first=scales, second=scales, k=parameters)
def test_sums_and_products(seed, first, second, k):
    rng = np.random.default_rng(seed)
    a, b = random_model(rng, first, k), random_model(rng, second, k)
    one, (e, f) = random_model(rng, first, k, functions=1), 3.7 * rng.standard_normal(2)
    results = (
        *(a + b, a - b, a * b, a.dot(b), one * b, b * one, a.scaled(f), a.shifted(f)),
        *(a.scaled(np.array([e, f])), a.shifted(np.array([e, f]))),
        *(a.weighted(np.array([[e, f]])), one.joined(a), a.functions(slice(None, None, -1))),
    )
    for u in steps(rng, k):
        (p, q), (r, s), (t,) = (stands_for(model, rng, u) for model in (a, b, one))
        values = (
            *([p + r, q + s], [p - r, q - s], [p * r, q * s], [p * r + q * s]),
            *([t * r, t * s], [t * r, t * s], [p * f, q * f], [p + f, q + f]),
            *([p * e, q * f], [p + e, q + f], [p * e + q * f], [t, p, q], [q, p]),
        )
        for model, found in zip(results, values, strict=True):
            for column, value in enumerate(found):
                assert_holds(model, column, u, value)


@settings(max_examples=80)
@given(seed=seeds, scale=scales, k=parameters)
def test_functions_of_models(seed, scale, k):
    rng = np.random.default_rng(seed)
    a = random_model(rng, scale, k)
    square = a.dot(a)
    results = {
        "sine": a.apply(SINE),
        "fall": a.apply(FALL),
        "squash": square.apply(SQUASH, least=0.0),
        "sech of root": square.apply(SECH_OF_ROOT, least=0.0),
        "decay": square.apply(DECAY, least=0.0),
        "inverse root": square.shifted(0.25).apply(INVERSE_ROOT, least=0.25),
    }
    for u in steps(rng, k):
        values = stands_for(a, rng, u)
        size = values[0] * values[0] + values[1] * values[1]
        for name, model in results.items():
            if name in FUNCTIONS:
                for column, value in enumerate(values):
                    assert_holds(model, column, u, FUNCTIONS[name](value))
            else:
                shift = arb(0.25) if name == "inverse root" else arb(0)
                assert_holds(model, 0, u, OF_A_SQUARE[name](size + shift))


def test_what_is_known_of_the_argument_is_used_and_safe():
    """The model of a square may have a value below zero, where the function has none."""
    model = TaylorModel(np.array([[[-0.1], [0.15], [0.0]]]), np.array([[0.2]]))
    found = model.apply(SQUASH, least=0.0)
    assert np.isfinite(found.upper).all()
    for u in (-1.0, 0.0, 0.5, 1.0):
        for share in (-1, 0, 1):
            value = arb(-0.1) + arb(0.15) * u + arb(0.2) * share
            if value >= 0:
                assert_holds(found, 0, [u], OF_A_SQUARE["squash"](value))


def test_the_remainder_falls_with_the_third_power_of_the_half_side():
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    patches = [Patches(np.array([[0.3, -0.7]]), half * turned[None]) for half in (0.02, 0.01)]
    first, second = (
        (x * x).apply(SINE).dot(x).apply(FALL).remainder[0, 0]
        for x in map(TaylorModel.position, patches)
    )
    assert first / second == pytest.approx(8, rel=0.1)


def test_parts_cover_their_cube_exactly():
    parts = Boxes(np.zeros((1, 3)), np.array([0.5])).quarters()
    assert sorted(map(tuple, parts.centers.tolist())) == list(product((-0.25, 0.25), repeat=3))
    assert (parts.half == 0.25).all()
    np.testing.assert_array_equal(parts.patches.axes, np.broadcast_to(np.eye(3) / 4, (8, 3, 3)))


def test_quarters_cover_their_square_exactly():
    boxes = divided(Boxes.square(4.0), 0.125)
    # In binary fractions all of this is exact.
    low = boxes.centers - boxes.half[:, None]
    assert set(boxes.half) == {0.125}
    grid = np.arange(-4, 4, 0.25)
    assert sorted(map(tuple, low.tolist())) == [(x, y) for x in grid for y in grid]


@settings(max_examples=80)
@given(seed=seeds, scale=scales, k=st.integers(1, 3))
def test_faces(seed, scale, k):
    rng = np.random.default_rng(seed)
    whole = random_model(rng, scale, k)
    parameter, side = int(rng.integers(k)), int(rng.choice([-1, 1]))
    face = whole.at_end(parameter, side)
    for v in steps(rng, k - 1):
        u = np.insert(v, parameter, side)
        for column, value in enumerate(stands_for(whole, rng, u)):
            assert_holds(face, column, v, value)
