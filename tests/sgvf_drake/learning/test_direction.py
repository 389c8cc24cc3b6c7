"""Which way along each piece: the rule, and what the user says against it."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning.direction import directed
from sgvf_drake.paths import reverse, trace_pieces, with_ends
from sgvf_drake.paths.draft import DIRECTIONS


@pytest.fixture(scope="module")
def circles(concentric):
    """The outer circle first: it is longer."""
    points = concentric[0].normalize(concentric[0].points)
    return points, trace_pieces(points)


@pytest.fixture(scope="module")
def line():
    """From (-4, -1) to (4, 1), in random order."""
    x = np.random.default_rng(0).permutation(np.linspace(-4, 4, 50))
    points = np.column_stack([x, x / 4])
    return points, trace_pieces(points)


@pytest.fixture(scope="module")
def ring():
    """A closed piece in space."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    points = 4 * np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])
    return points, trace_pieces(points)


def turn(points, piece):
    """Twice the signed area: positive counter-clockwise."""
    x, y = points[piece.order].T
    return x @ np.roll(y, -1) - y @ np.roll(x, -1)


def turns(points, pieces):
    return [int(np.sign(turn(points, piece))) for piece in pieces]


def same(piece, other):
    return all(
        np.array_equal(getattr(piece, name), getattr(other, name))
        for name in ("indices", "order", "edges", "closed", "length")
    ) and np.allclose(piece.arc, other.arc, rtol=0, atol=1e-12 * piece.length)


def check_arc(piece):
    """The arc length grows along the order, from zero."""
    arc = dict(zip(piece.indices.tolist(), piece.arc.tolist(), strict=True))
    along = np.array([arc[index] for index in piece.order.tolist()])
    assert along[0] == pytest.approx(0, abs=1e-12)
    assert (np.diff(along) > 0).all()
    assert piece.arc.min() >= -1e-12


def test_any_piece_can_be_reversed_and_twice_is_no_change(circles, line, ring):
    for points, pieces in (circles, line, ring):
        for piece in pieces:
            check_arc(piece)
            back = reverse(piece)
            check_arc(back)
            np.testing.assert_array_equal(back.order, piece.order[::-1])
            assert same(reverse(back), piece)
            assert not same(back, piece)
        kept, turned = (directed(points, pieces, d) for d in (None, "reverse"))
        assert all(map(same, kept, pieces))
        assert all(map(same, turned, map(reverse, pieces)))


def test_every_choice_for_closed_pieces(circles):
    assert DIRECTIONS == ("ccw", "cw", "reverse")
    points, pieces = circles
    for direction, expected in (
        (None, [1, 1]),
        ("ccw", [1, 1]),
        ("cw", [-1, -1]),
        ("reverse", [-1, -1]),
        (("cw", "ccw"), [-1, 1]),
        (("ccw", "cw"), [1, -1]),
        ((None, "reverse"), [1, -1]),
        (["reverse", None], [-1, 1]),
    ):
        chosen = directed(points, pieces, direction)
        assert turns(points, chosen) == expected
        for piece in chosen:
            check_arc(piece)
        # A turn is absolute, whatever the pieces were before.
        if direction in ("ccw", "cw"):
            backward = [reverse(piece) for piece in pieces]
            assert turns(points, directed(points, backward, direction)) == expected
    # A start point says nothing about closed pieces.
    assert all(map(same, directed(points, pieces, None, np.array([4.0, 0.0])), pieces))


def test_choices_that_do_not_fit_are_refused(circles, line, ring):
    points, pieces = circles
    for count in (0, 1, 3):
        match = f"direction has {count} entries, but the path has 2 pieces"
        with pytest.raises(ConfigurationError, match=match):
            directed(points, pieces, ["cw"] * count)
    # Only closed pieces in the plane turn.
    for points, pieces in (line, ring):
        for direction in ("cw", "ccw", ("cw",)):
            with pytest.raises(ConfigurationError, match=r"'c?cw' is for closed pieces"):
                directed(points, pieces, direction)


def test_an_open_piece_starts_near_a_start_point(line):
    points, pieces = line
    west = np.broadcast_to([-1.0, 0.0], points.shape)
    for start, direction, velocities, first in (
        (None, None, None, -4),
        ([-9.0, 0.0], None, None, -4),
        ([3.0, 5.0], None, None, 4),
        ([0.1, 0.0], None, None, 4),
        ([3.0, 5.0], "reverse", None, -4),
        (None, "reverse", None, 4),
        # Velocities come before the rule, and a start point before them.
        (None, None, west, 4),
        ([-4.0, 0.0], None, west, -4),
    ):
        start = None if start is None else np.array(start)
        (piece,) = directed(points, pieces, direction, start, velocities)
        check_arc(piece)
        assert points[piece.order[0], 0] == pytest.approx(first)


def test_velocities_tell_the_direction_of_each_piece(circles):
    """Counter-clockwise on the outer circle and clockwise on the inner one."""
    points, pieces = circles
    tangent = np.column_stack([-points[:, 1], points[:, 0]])
    outer = np.linalg.norm(points, axis=1) > 3
    velocities = tangent * np.where(outer, 1.0, -1.0)[:, None]
    velocities += 0.5 * np.random.default_rng(0).standard_normal(velocities.shape)
    few = np.zeros_like(points)
    some = np.random.default_rng(1).choice(len(points), 20, replace=False)
    few[some] = -tangent[some]
    for direction, known, expected in (
        (None, velocities, [1, -1]),
        (None, -velocities, [-1, 1]),
        # A direction comes before them; `reverse` is of what they say.
        ("ccw", velocities, [1, 1]),
        ("reverse", velocities, [-1, 1]),
        # Those known in places are enough.
        (None, 0 * few, [1, 1]),
        (None, few, [-1, -1]),
    ):
        assert turns(points, directed(points, pieces, direction, None, known)) == expected


def test_a_piece_is_closed_or_opened(circles, line):
    for points, pieces in (circles, line):
        piece = pieces[0]
        assert with_ends(piece, points, piece.closed) is piece
        other = with_ends(piece, points, not piece.closed)
        check_arc(other)
        assert other.closed != piece.closed
        ends = points[piece.order[[0, -1]]]
        gap = np.linalg.norm(ends[1] - ends[0])
        assert other.length == pytest.approx(piece.length + (gap if other.closed else -gap))
    # An opened one starts at the smaller x.
    points, pieces = circles
    opened = with_ends(pieces[0], points, closed=False)
    first, last = points[opened.order[[0, -1]]]
    assert tuple(first) <= tuple(last)
    # One that is closed turns counter-clockwise.
    for angle in np.linspace(0.1, 6.2, 7):
        t = np.linspace(0, 1.5 * np.pi, 60) + angle
        points = np.column_stack([np.cos(t), np.sin(t)])
        (piece,) = trace_pieces(points)
        assert not piece.closed
        closed = with_ends(piece, points, closed=True)
        check_arc(closed)
        assert turn(points, closed) > 0
