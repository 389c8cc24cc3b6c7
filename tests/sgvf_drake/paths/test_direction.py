"""Which way along each piece: the rule, and what the user says against it."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.draft import DIRECTIONS
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.polyline import signed_area


def line(velocities=None):
    """From (-4, -1) to (4, 1), in random order."""
    x = np.random.default_rng(0).permutation(np.linspace(-4, 4, 50))
    return PointCloud(np.column_stack([x, x / 4]), velocities=velocities)


def ring():
    """A closed path in space, in random order."""
    angle = np.random.default_rng(1).permutation(np.linspace(0, 2 * np.pi, 60, endpoint=False))
    x, y = np.cos(angle), np.sin(angle)
    return PointCloud(4 * np.column_stack([x, 0.6 * y, 0.8 * y]))


def turns(cloud, **options):
    """The sense of each closed path, the longest first: 1 is counter-clockwise."""
    network = find_paths(cloud, **options)
    return [int(np.sign(signed_area(piece.vertices))) for piece in network.path.pieces]


def test_every_choice_for_closed_paths(concentric):
    """The outer circle comes first: it is longer."""
    assert DIRECTIONS == ("ccw", "cw", "reverse")
    cloud, _ = concentric
    for direction, expected in (
        (None, [1, 1]),
        ("ccw", [1, 1]),
        ("cw", [-1, -1]),
        ("reverse", [-1, -1]),
        (("cw", "ccw"), [-1, 1]),
        ((None, "reverse"), [1, -1]),
        (["reverse", None], [-1, 1]),
    ):
        assert turns(cloud, direction=direction) == expected
    # A start says nothing about closed paths.
    assert turns(cloud, start=[4.0, 0.0]) == [1, 1]


def test_choices_that_do_not_fit_are_refused(concentric):
    for count in (0, 1, 3):
        match = f"direction has {count} entries, but the path has 2 pieces"
        with pytest.raises(ConfigurationError, match=match):
            find_paths(concentric[0], direction=["cw"] * count)
    # Only closed paths in the plane turn.
    for cloud in (line(), ring()):
        for direction in ("cw", "ccw", ("cw",)):
            with pytest.raises(ConfigurationError, match=r"'c?cw' is for closed paths"):
                find_paths(cloud, direction=direction)


def test_an_open_path_starts_near_a_start_point():
    west = np.tile([-1.0, 0.0], (50, 1))
    for start, direction, velocities, first in (
        (None, None, None, -4),
        ([-9.0, 0.0], None, None, -4),
        ([3.0, 5.0], None, None, 4),
        ([0.1, 0.0], None, None, 4),
        ([3.0, 5.0], "reverse", None, -4),
        (None, "reverse", None, 4),
        # Velocities come before the rule, and a start before them.
        (None, None, west, 4),
        ([-4.0, 0.0], None, west, -4),
    ):
        network = find_paths(line(velocities), start=start, direction=direction)
        assert network.path.pieces[0].vertices[0, 0] == pytest.approx(first)


def test_velocities_tell_the_direction_of_each_path(concentric):
    """Counter-clockwise on the outer circle and clockwise on the inner one."""
    points = concentric[0].points
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
        (None, few, [-1, -1]),
    ):
        assert turns(PointCloud(points, velocities=known), direction=direction) == expected
