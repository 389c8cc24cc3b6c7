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


def powers(zeros, order):
    return on_plane(lambda z: np.prod([(z - zero) ** order for zero in zeros], axis=0))


@pytest.mark.parametrize("order", [1, 2, 3, 7])
def test_powers_turn_as_often_as_their_order(order):
    curve = circle(np.zeros(2), 0.3)
    assert winding_number(powers([0], order), curve) == order
    conjugate = on_plane(lambda z: np.conj(z) ** order)
    assert winding_number(conjugate, curve) == -order
    assert winding_number(powers([0], order), curve[::-1]) == -order


def test_a_field_without_a_zero_inside_does_not_turn():
    assert winding_number(powers([5], 3), circle(np.zeros(2), 0.3)) == 0
    assert winding_number(on_plane(np.exp), box_corners(BOX)) == 0


def test_the_sides_of_a_box_are_sampled():
    # From corner to corner, z^7 turns more than once around.
    assert winding_number(powers([0], 7), box_corners(BOX)) == 7


def test_a_zero_close_to_the_curve_is_on_its_side():
    for beside, expected in ((-1e-9, 1), (1e-9, 0)):
        field = powers([1 + beside + 0.3j], 1)
        assert winding_number(field, box_corners(BOX)) == expected


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


@settings(max_examples=60, deadline=None, derandomize=True)
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


@pytest.mark.parametrize("zero", [1 + 0.3j, -2 - 1j])
def test_a_zero_on_the_curve_is_an_error_that_names_it(zero):
    with pytest.raises(ConfigurationError, match="vanishes at") as error:
        winding_number(powers([zero], 1), box_corners(BOX))
    named = re.search(r"at \[(.*?), (.*?)\]", str(error.value))
    assert np.allclose(np.array(named.groups(), float), [zero.real, zero.imag], atol=1e-9)


def test_a_jump_is_an_error():
    def field(x):
        return np.column_stack([np.where(x[:, 0] < 0.3, -1.0, 1.0), 0 * x[:, 0]])

    with pytest.raises(ConfigurationError, match="vanishes at"):
        winding_number(field, box_corners(BOX))


def test_turning_adds_up_along_a_line():
    starts, ends = np.array([[1.0, -5]]), np.array([[1.0, 5]])
    whole = turning(powers([0], 3), starts, ends)
    assert whole == pytest.approx(3 * 2 * np.arctan(5))
    parts = cut(starts, ends, 0.7)
    assert turning(powers([0], 3), *parts) == pytest.approx(whole)
    assert turning(powers([0], 3), ends, starts) == pytest.approx(-whole)


def test_cutting_keeps_the_ends_and_bounds_the_lengths():
    starts, ends = np.array([[0.0, 0], [1, 1]]), np.array([[3.0, 4], [1, 1.5]])
    begin, end = cut(starts, ends, 0.9)
    lengths = np.linalg.norm(end - begin, axis=1)
    assert lengths.max() <= 0.9
    assert lengths.sum() == pytest.approx(5.5)
    assert np.allclose(begin[1:6], end[:5])
    assert cut(starts, ends, np.inf)[0].shape == (2, 2)


def test_boxes_and_circles_run_counter_clockwise():
    for curve in (box_corners(BOX), circle(np.array([4.0, 5]), 2.0)):
        x, y = curve.T
        assert x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0
    assert np.allclose(np.linalg.norm(circle(np.array([4.0, 5]), 2.0) - [4, 5], axis=1), 2)
