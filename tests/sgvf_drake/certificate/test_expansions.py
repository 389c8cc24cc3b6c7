"""Functions of one variable: their bounds hold in ball arithmetic, everywhere."""

from itertools import pairwise

from flint import arb
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.expansions import (
    ACTIVATIONS,
    COSINE,
    DECAY,
    FALL,
    INVERSE_ROOT,
    INVERSE_SINHC,
    SECH_OF_ROOT,
    SINE,
    SQUASH,
    WAVES,
    find_expansion,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import ACTIVATIONS as ALL

from .balls import FUNCTIONS, OF_A_SQUARE, SLOPES_OF_A_SQUARE, derivative, rectified

SMOOTH = {name: ACTIVATIONS[name] for name in FUNCTIONS if name in ACTIVATIONS}
SMOOTH |= {"sine": SINE, "cosine": COSINE, "fall": FALL}
KINKED = {name: ACTIVATIONS[name] for name in ("ELU", "ReLU")}
CONVEX = {
    "inverse root": INVERSE_ROOT,
    "squash": SQUASH,
    "sech of root": SECH_OF_ROOT,
    "inverse sinhc": INVERSE_SINHC,
    "decay": DECAY,
}

anywhere = st.one_of(
    st.floats(-1e3, 1e3), st.floats(-6, 6), st.sampled_from([0.0, -0.0, 1e-300, 745.0, -745.0])
)
reaches = st.one_of(
    st.floats(0, 10), st.floats(-16, 2).map(lambda e: 10.0**e), st.sampled_from([0.0, 1e3])
)
shares = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 1.0]))


def excess(expand, function, u, low, high, at):
    """How far the function is outside of its expansion at a point; at most zero."""
    found = expand(*(np.array([[value]]) for value in (u, low, high)))
    parts = (found.value, found.slope, found.curvature, found.rest)
    value, slope, curvature, rest = (arb(float(part[0, 0])) for part in parts)
    t = arb(at) - arb(u)
    return abs(function(arb(at)) - (value + slope * t + curvature * t * t / 2)) - rest


def interval(u, reach, below, above, least=-np.inf):
    low, high = max(u - reach * below, least), u + reach * above
    return low, high


@pytest.mark.parametrize("name", [*SMOOTH, *KINKED])
@settings(max_examples=150)
@given(u=anywhere, reach=reaches, below=shares, above=shares, share=shares)
def test_a_function_is_inside_of_its_expansion(name, u, reach, below, above, share):
    low, high = interval(u, reach, below, above)
    at = float(np.clip(low + share * (high - low), low, high))
    function = FUNCTIONS.get(name) or rectified(name)
    assert excess((SMOOTH | KINKED)[name].expand, function, u, low, high, at) <= 0
    if name in SMOOTH:
        slope = SMOOTH[name].expand_slope
        assert excess(slope, lambda z: derivative(function, 1, z), u, low, high, at) <= 0


@pytest.mark.parametrize("name", CONVEX)
@settings(max_examples=150)
@given(
    exponent=st.floats(-12, 7),
    reach=st.floats(-14, 3).map(lambda e: 10.0**e),
    below=shares,
    above=shares,
    share=shares,
)
def test_a_function_of_a_square_is_inside_of_its_expansion(
    name, exponent, reach, below, above, share
):
    u = 10.0**exponent
    least = 1e-14 if name == "inverse root" else 0.0
    low, high = interval(u, reach * u, below, above, least)
    at = float(np.clip(low + share * (high - low), low, high))
    assert excess(CONVEX[name].expand, OF_A_SQUARE[name], u, low, high, at) <= 0
    # Nearer to zero the formulas of the slopes cancel, in balls too.
    if at > 1e-20:
        slope = CONVEX[name].expand_slope
        assert excess(slope, SLOPES_OF_A_SQUARE[name], u, low, high, at) <= 0


@pytest.mark.parametrize("name", ["squash", "sech of root", "inverse sinhc", "decay"])
def test_a_function_of_a_square_may_start_at_zero(name):
    for high in (0.0, 1e-20, 1e-3, 0.02, 0.5, 3.0, 1e4):
        for at in (0.0, high / 3, high):
            assert excess(CONVEX[name].expand, OF_A_SQUARE[name], 0.0, 0.0, high, at) <= 0


def is_between(function, order, least, most, reach=40.0, narrowest=1e-7):
    """Whether a derivative is in [least, most] on [-reach, reach], by balls that cover it."""
    # The exponential of a wide ball holds zero and below, and cannot be divided by.
    ends = np.arange(-2 * reach, 2 * reach + 1) / 2
    parts = list(pairwise(map(float, ends)))
    while parts:
        low, high = parts.pop()
        middle, radius = (low + high) / 2, (high - low) / 2
        ball = derivative(function, order, arb(middle, radius))
        if ball >= least and ball <= most:
            continue
        if radius < narrowest:
            return False
        parts += [(low, middle), (middle, high)]
    return True


@pytest.mark.parametrize("name", ["SiLU", "Tanh", "Sigmoid", "Softplus", "GELU", "fall"])
def test_the_constants_bound_the_derivatives(name):
    """On [-40, 40] by balls; farther out all of these derivatives are below 1e-4.

    Each is a polynomial in u of degree three at most times a factor that is below 4 exp(-|u|),
    or below exp(-u^2 / 2), or else, of 1 / (1 + u^4), it is below 200 / |u|^6.
    """
    function, expansion = FUNCTIONS[name], SMOOTH[name]
    assert is_between(function, 2, expansion.least, expansion.most)
    assert is_between(function, 3, -expansion.third, expansion.third)
    # They are not far above.
    third = 0.9 * expansion.third
    assert not is_between(function, 3, -third, third, narrowest=1e-3)
    assert not is_between(function, 2, expansion.least, 0.99 * expansion.most, narrowest=1e-3)


def test_the_steepest_slope_of_the_bell_is_a_bound():
    function = FUNCTIONS["fall"]
    assert is_between(function, 1, -FALL.steepest, FALL.steepest)
    assert not is_between(function, 1, -1.065, 1.065, narrowest=1e-3)


@pytest.mark.parametrize("name", ["fall", *CONVEX])
def test_over_a_wide_range_an_expansion_leaves_no_more_than_the_range(name):
    """As of a square that the bounds of a score leave open: a parabola is far too much."""
    expansion = (SMOOTH | CONVEX)[name]
    low, u, high = (np.array([[value]]) for value in (4.0, 400.0, 900.0))
    for expand in (expansion.expand, expansion.expand_slope):
        ends = [expand(end, end, end).value for end in (low, high)]
        assert expand(u, low, high).rest <= 0.51 * abs(ends[0] - ends[1])


def test_exponentials_are_right_within_four_units():
    """Also at the ends of the intervals of each power of two, where the series is longest."""
    rng = np.random.default_rng(0)
    halves = (np.arange(-1009, 1009) + 0.5) * np.log(2)
    x = np.concatenate(
        [rng.uniform(-700, 700, 2000), rng.uniform(-1, 1, 2000), halves, [0.0, -700.0, 700.0]]
    )
    found, scale = np.empty((2, len(x)))
    kernels._exponentials(x, scale, found)
    for at, value in zip(x, found, strict=True):
        expected = arb(float(at)).exp()
        assert abs(arb(float(value)) - expected) <= 4 * kernels.UNIT * expected
    far = np.array([-1e300, -800.0, 800.0, 1e300])
    kernels._exponentials(far, scale[:4], found[:4])
    assert found[:4].tolist() == pytest.approx(np.exp([-700.0, -700, 700, 700]), rel=1e-15)


def test_waves_are_sines_and_cosines():
    u, reach = np.random.default_rng(1).uniform(-9, 9, (1, 8)), 0.1
    both = np.concatenate([u, u], axis=1)
    for name in ("expand", "expand_slope"):
        found = getattr(WAVES, name)(both, both - reach, both + reach)
        apart = [getattr(one, name)(u, u - reach, u + reach) for one in (SINE, COSINE)]
        for part in ("value", "slope", "curvature", "rest"):
            halves = np.split(getattr(found, part), 2, axis=1)
            for half, one in zip(halves, apart, strict=True):
                np.testing.assert_array_equal(half, getattr(one, part))


def test_every_activation_that_a_network_may_have_is_bounded():
    assert set(ACTIVATIONS) == {activation.name for activation in ALL}
    with pytest.raises(ConfigurationError, match="Mish"):
        find_expansion("Mish")
