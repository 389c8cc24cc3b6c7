"""Winding numbers: of powers, of planted zeros, around corners, and where there is none."""

import re

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.lyapunov.winding import box_corners, circle, cut, turning, winding_number

BOX = (np.array([-2.0, -1.0]), np.array([1.0, 3.0]))


def on_plane(f):
    """A complex function as a planar field."""

    def field(x):
        values = f(x[:, 0] + 1j * x[:, 1])
        return np.column_stack([values.real, values.imag])

    return field


def power(order, zero=0):
    return on_plane(lambda z: (z - zero) ** order)


def test_powers_turn_as_often_as_their_order():
    curve = circle(np.zeros(2), 0.3)
    for order in (1, 2, 3, 7):
        assert winding_number(power(order), curve) == order
        assert winding_number(on_plane(lambda z, k=order: np.conj(z) ** k), curve) == -order
        assert winding_number(power(order), curve[::-1]) == -order
    assert winding_number(power(3, 5), curve) == 0
    # From corner to corner, z^7 turns more than once around.
    assert winding_number(power(7), box_corners(BOX)) == 7
    # On which side of the curve a zero is, however close.
    for beside, expected in ((-1e-9, 1), (1e-9, 0)):
        assert winding_number(power(1, 1 + beside + 0.3j), box_corners(BOX)) == expected


def test_spacing_tells_turns_that_are_short():
    # Once around within a thousandth of the lower side, and the same before and after.
    def field(x):
        part = np.clip((x[:, 0] - 0.1111) / 0.003, 0, 1) * (x[:, 1] < -0.5)
        return np.column_stack([np.cos(2 * np.pi * part), np.sin(2 * np.pi * part)])

    assert winding_number(field, box_corners(BOX)) == 0
    assert winding_number(field, box_corners(BOX), spacing=0.001) == 1


zeros = st.lists(
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(lambda z: complex(*z)), max_size=5
)


@settings(max_examples=60, derandomize=True)
@given(zeros, zeros)
def test_the_winding_number_counts_what_is_inside(positive, negative):
    def is_inside(z):
        return BOX[0][0] < z.real < BOX[1][0] and BOX[0][1] < z.imag < BOX[1][1]

    def border_distance(z):
        x = np.array([z.real, z.imag])
        return np.abs(np.concatenate([x - BOX[0], x - BOX[1]])).min()

    if any(border_distance(z) < 1e-6 for z in (*positive, *negative)):
        return
    field = on_plane(
        lambda z: (
            np.prod([z - a for a in positive] or [np.ones_like(z)], axis=0)
            * np.prod([np.conj(z - b) for b in negative] or [np.ones_like(z)], axis=0)
        )
    )
    expected = sum(map(is_inside, positive)) - sum(map(is_inside, negative))
    assert winding_number(field, box_corners(BOX)) == expected


def test_a_zero_or_a_jump_on_the_curve_is_an_error_that_names_the_place():
    for zero in (1 + 0.3j, -2 - 1j):
        with pytest.raises(ConfigurationError, match="vanishes at") as error:
            winding_number(power(1, zero), box_corners(BOX))
        named = re.search(r"at \[(.*?), (.*?)\]", str(error.value))
        assert np.allclose(np.array(named.groups(), float), [zero.real, zero.imag], atol=1e-9)
    jump = on_plane(lambda z: np.where(z.real < 0.3, -1.0, 1.0) + 0j)
    with pytest.raises(ConfigurationError, match="vanishes at"):
        winding_number(jump, box_corners(BOX))


def test_turning_adds_up_along_a_line():
    starts, ends = np.array([[1.0, -5]]), np.array([[1.0, 5]])
    assert turning(power(3), starts, ends) == pytest.approx(3 * 2 * np.arctan(5))
    begin, end = cut(starts, ends, 0.7)
    assert np.linalg.norm(end - begin, axis=1).max() <= 0.7
    assert np.allclose(begin[1:], end[:-1])
    assert turning(power(3), begin, end) == pytest.approx(3 * 2 * np.arctan(5))
    assert turning(power(3), ends, starts) == pytest.approx(-3 * 2 * np.arctan(5))
