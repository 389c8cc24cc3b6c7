import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning.direction import DIRECTIONS, directed
from sgvf_drake.learning.orientation import orientation_hint
from sgvf_drake.learning.support import find_support
from sgvf_drake.paths import make_shape, reverse, trace_pieces, with_ends


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


@pytest.mark.parametrize("cloud", ["circles", "line", "ring"])
def test_reversing_twice_is_no_change(cloud, request):
    _, pieces = request.getfixturevalue(cloud)
    for piece in pieces:
        check_arc(piece)
        back = reverse(piece)
        check_arc(back)
        np.testing.assert_array_equal(back.order, piece.order[::-1])
        assert same(reverse(back), piece)
        assert not same(back, piece)


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        (None, [1, 1]),
        ("ccw", [1, 1]),
        ("cw", [-1, -1]),
        ("reverse", [-1, -1]),
        (("cw", "ccw"), [-1, 1]),
        (("ccw", "cw"), [1, -1]),
        ((None, "reverse"), [1, -1]),
        (["reverse", None], [-1, 1]),
    ],
)
def test_every_choice_for_closed_pieces(circles, direction, expected):
    points, pieces = circles
    chosen = directed(points, pieces, direction)
    assert turns(points, chosen) == expected
    for piece in chosen:
        check_arc(piece)
    # A turn is absolute, whatever the pieces were before.
    if direction in ("ccw", "cw"):
        backward = [reverse(piece) for piece in pieces]
        assert turns(points, directed(points, backward, direction)) == expected


def test_the_choices_are_those_that_are_documented():
    assert DIRECTIONS == ("ccw", "cw", "reverse")


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_choice_for_each_piece_has_to_fit(circles, count):
    points, pieces = circles
    with pytest.raises(
        ConfigurationError, match=f"direction has {count} entries, but the path has 2 pieces"
    ):
        directed(points, pieces, ["cw"] * count)


@pytest.mark.parametrize("cloud", ["line", "ring"])
@pytest.mark.parametrize("direction", ["cw", "ccw", ("cw",)])
def test_only_closed_pieces_in_the_plane_turn(cloud, direction, request):
    points, pieces = request.getfixturevalue(cloud)
    with pytest.raises(ConfigurationError, match=r"direction 'c?cw' is for closed pieces"):
        directed(points, pieces, direction)


@pytest.mark.parametrize("cloud", ["line", "ring"])
def test_any_piece_can_be_reversed(cloud, request):
    points, pieces = request.getfixturevalue(cloud)
    (same_way,), (other_way,) = (directed(points, pieces, d) for d in (None, "reverse"))
    assert same(same_way, pieces[0])
    assert same(other_way, reverse(pieces[0]))


@pytest.mark.parametrize(
    ("start", "direction", "first"),
    [
        (None, None, -4),
        ([-9.0, 0.0], None, -4),
        ([3.0, 5.0], None, 4),
        ([0.1, 0.0], None, 4),
        ([3.0, 5.0], "reverse", -4),
        (None, "reverse", 4),
    ],
)
def test_an_open_piece_starts_near_a_start_point(line, start, direction, first):
    points, pieces = line
    start = None if start is None else np.array(start)
    (piece,) = directed(points, pieces, direction, start)
    check_arc(piece)
    assert points[piece.order[0], 0] == pytest.approx(first)


def test_a_start_point_says_nothing_about_closed_pieces(circles):
    points, pieces = circles
    chosen = directed(points, pieces, None, np.array([4.0, 0.0]))
    assert all(same(a, b) for a, b in zip(chosen, pieces, strict=True))


def test_velocities_tell_the_direction_of_each_piece(circles):
    """Counter-clockwise on the outer circle and clockwise on the inner one."""
    points, pieces = circles
    tangent = np.column_stack([-points[:, 1], points[:, 0]])
    outer = np.linalg.norm(points, axis=1) > 3
    velocities = tangent * np.where(outer, 1.0, -1.0)[:, None]
    velocities += 0.5 * np.random.default_rng(0).standard_normal(velocities.shape)
    assert turns(points, directed(points, pieces, None, None, velocities)) == [1, -1]
    assert turns(points, directed(points, pieces, None, None, -velocities)) == [-1, 1]
    # A direction comes before them; `reverse` is of what they say.
    assert turns(points, directed(points, pieces, "ccw", None, velocities)) == [1, 1]
    assert turns(points, directed(points, pieces, "reverse", None, velocities)) == [-1, 1]


def test_velocities_known_in_places_are_enough(circles):
    points, pieces = circles
    velocities = np.zeros_like(points)
    assert turns(points, directed(points, pieces, None, None, velocities)) == [1, 1]
    some = np.random.default_rng(1).choice(len(points), 20, replace=False)
    velocities[some] = np.column_stack([points[some, 1], -points[some, 0]])
    assert turns(points, directed(points, pieces, None, None, velocities)) == [-1, -1]


def test_a_start_point_comes_before_velocities(line):
    points, pieces = line
    west = np.broadcast_to([-1.0, 0.0], points.shape)
    (piece,) = directed(points, pieces, None, None, west)
    assert points[piece.order[0], 0] == pytest.approx(4)
    (piece,) = directed(points, pieces, None, np.array([-4.0, 0.0]), west)
    assert points[piece.order[0], 0] == pytest.approx(-4)


def test_a_piece_is_closed_or_opened(circles, line):
    for points, pieces in (circles, line):
        piece = pieces[0]
        assert with_ends(piece, points, piece.closed) is piece
        other = with_ends(piece, points, not piece.closed)
        check_arc(other)
        assert other.closed != piece.closed
        ends = points[piece.order[[0, -1]]]
        gap = np.linalg.norm(ends[1] - ends[0])
        assert abs(other.length - piece.length) == pytest.approx(gap)
        assert other.length == pytest.approx(piece.length + (gap if other.closed else -gap))
    # An opened one starts at the smaller x.
    points, pieces = circles
    opened = with_ends(pieces[0], points, closed=False)
    first, last = points[opened.order[[0, -1]]]
    assert tuple(first) <= tuple(last)


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.2, 7))
def test_a_piece_that_is_closed_turns_counter_clockwise(angle):
    t = np.linspace(0, 1.5 * np.pi, 60) + angle
    points = np.column_stack([np.cos(t), np.sin(t)])
    (piece,) = trace_pieces(points)
    assert not piece.closed
    closed = with_ends(piece, points, closed=True)
    check_arc(closed)
    assert turn(points, closed) > 0


@pytest.mark.parametrize("name", ["concentric-circles", "star"])
def test_the_hint_of_reversed_pieces_is_the_negative(name):
    """What a field learns its direction from."""
    cloud, _ = make_shape(name)
    support = find_support(cloud.normalize(cloud.points))
    forward = orientation_hint(support.points, support.pieces, support.sigma)
    back = [reverse(piece) for piece in support.pieces]
    backward = orientation_hint(support.points, back, support.sigma)
    np.testing.assert_allclose(backward, -forward, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(forward, axis=1), 1, rtol=1e-12)
