"""The arithmetic of Taylor models: whatever they stand for, the result stands for its value.

A function that a model stands for is its polynomial plus a share, between -1 and 1, of its
remainder; a different one at every step.
"""

from flint import arb
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import FALL, INVERSE_ROOT, SECH_OF_ROOT, SINE, SQUASH
from sgvf_drake.certificate.taylor_model import TaylorModel

from .balls import FUNCTIONS, OF_A_SQUARE, divided, model_at

scales = st.integers(-12, 6).map(lambda exponent: 10.0**exponent)
seeds = st.integers(0, 2**32 - 1)
CORNERS = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])


def random_model(rng, scale, half, functions=2, boxes=1):
    """Models whose parts are zero, small or large, of any sign."""

    def part(*shape):
        kind = rng.choice([0.0, 1e-6, 1.0, 30.0], size=shape)
        return scale * kind * rng.standard_normal(shape)

    remainder = np.abs(part(boxes, functions))
    return TaylorModel(np.full(boxes, half), part(boxes, 6, functions), remainder)


def steps(rng, half):
    """Steps to the corners, the middles of the sides, the centre, and at random."""
    return half * np.concatenate([CORNERS, rng.uniform(-1, 1, (6, 2))])


def stands_for(model, rng, d):
    """Values of functions that a model stands for, at a step d: the extremes among them."""
    values = []
    for column in range(model.value.shape[1]):
        polynomial, remainder = model_at(model, 0, column, d)
        values.append(
            polynomial + remainder * float(rng.choice([-1, 0, 1, rng.uniform(-1, 1)]))
        )
    return values


def assert_holds(model, column, d, value):
    polynomial, remainder = model_at(model, 0, column, d)
    assert abs(value - polynomial) <= remainder
    assert arb(float(model.lower[0, column])) <= value
    assert value <= arb(float(model.upper[0, column]))
    assert abs(value) <= arb(float(model.magnitude[0, column]))


@settings(max_examples=80)
@given(seed=seeds, first=scales, second=scales, half=scales)
def test_sums_and_products(seed, first, second, half):
    rng = np.random.default_rng(seed)
    a, b = random_model(rng, first, half), random_model(rng, second, half)
    one, factor = random_model(rng, first, half, functions=1), 3.7 * rng.standard_normal()
    results = (a + b, a - b, a * b, a.dot(b), one * b, a.scaled(factor), a.shifted(factor))
    for d in steps(rng, half):
        (p, q), (r, s), (u,) = (stands_for(model, rng, d) for model in (a, b, one))
        values = (
            *([p + r, q + s], [p - r, q - s], [p * r, q * s], [p * r + q * s]),
            *([u * r, u * s], [p * factor, q * factor], [p + factor, q + factor]),
        )
        for model, found in zip(results, values, strict=True):
            for column, value in enumerate(found):
                assert_holds(model, column, d, value)


@settings(max_examples=80)
@given(seed=seeds, scale=scales, half=scales)
def test_functions_of_models(seed, scale, half):
    rng = np.random.default_rng(seed)
    a = random_model(rng, scale, half)
    square = a.dot(a)
    results = {
        "sine": a.apply(SINE),
        "fall": a.apply(FALL),
        "squash": square.apply(SQUASH, least=0.0),
        "sech of root": square.apply(SECH_OF_ROOT, least=0.0),
        "inverse root": square.shifted(0.25).apply(INVERSE_ROOT, least=0.25),
    }
    for d in steps(rng, half):
        values = stands_for(a, rng, d)
        size = values[0] * values[0] + values[1] * values[1]
        for name, model in results.items():
            if name in FUNCTIONS:
                for column, value in enumerate(values):
                    assert_holds(model, column, d, FUNCTIONS[name](value))
            else:
                shift = arb(0.25) if name == "inverse root" else arb(0)
                assert_holds(model, 0, d, OF_A_SQUARE[name](size + shift))


def test_what_is_known_of_the_argument_is_used_and_safe():
    """The model of a square may have a value below zero, where the function has none."""
    model = TaylorModel(
        np.array([0.5]),
        np.array([[[-0.1], [0.3], [0.0], [0.0], [0.0], [0.0]]]),
        np.array([[0.2]]),
    )
    found = model.apply(SQUASH, least=0.0)
    assert np.isfinite(found.upper).all()
    for d in (-0.5, 0.0, 0.25, 0.5):
        for share in (-1, 0, 1):
            value = arb(-0.1) + arb(0.3) * d + arb(0.2) * share
            if value >= 0:
                assert_holds(found, 0, [d, 0.0], OF_A_SQUARE["squash"](value))


def test_the_remainder_falls_with_the_third_power_of_the_half_side():
    boxes = [Boxes(np.array([[0.3, -0.7]]), np.array([half])) for half in (0.02, 0.01)]
    first, second = (
        (x * x).apply(SINE).dot(x).apply(FALL).remainder[0, 0]
        for x in map(TaylorModel.position, boxes)
    )
    assert first / second == pytest.approx(8, rel=0.1)


def test_quarters_cover_their_square_exactly():
    boxes = divided(Boxes.square(4.0), 0.125)
    # In binary fractions all of this is exact.
    low = boxes.centers - boxes.half[:, None]
    assert set(boxes.half) == {0.125}
    grid = np.arange(-4, 4, 0.25)
    assert sorted(map(tuple, low.tolist())) == [(x, y) for x in grid for y in grid]
