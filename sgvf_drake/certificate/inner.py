"""A thinner tube inside of the first: where the closed orbits are, by another noise level.

The first V has to fall far from the path, and its ripple along the waypoints keeps its tube
wide.  A V of a higher noise level has no ripple, but its valley lies a little aside where the
path bends.  Which one shows the orbits best is tried; since every orbit of the first tube is in
{V' <= c_out'}, it is in {V' <= c_in'} where V' is proved to fall in between.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.decrease import Decrease
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from sgvf_drake.certificate.squares import HALF_WIDTH, Squares
from sgvf_drake.certificate.statement import Conditions
from sgvf_drake.certificate.topology import Shape, shape_of_band
from sgvf_drake.fields import GuidingField

# Noise levels that are tried, in those of the field.
RATIOS = (1.0, 1.4, 2.0, 2.8)
# Random points of the tube at which it is looked where V' falls.
NUM_POINTS = 20_000
# A level at which V' does not fall is left out with this margin, and so many times.
LEVEL_MARGIN, LEVEL_FLOOR = 0.05, 5e-4
ATTEMPTS = 6


@dataclass(frozen=True, eq=False)
class Inner:
    """A tube inside of another, proved.

    Attributes:
        conditions: V', and the band of its levels on which it falls.
        shape: The components and holes of {V' <= c_in'}.
        boxes: Over how many squares the field was bounded for it.
    """

    conditions: Conditions
    shape: Shape
    boxes: int


def find_inner(field: GuidingField, outer: Conditions, tube: Boxes) -> Inner | None:
    """Searches for the thinnest tube inside of one.

    Args:
        field: The field.
        outer: The conditions of the first tube, which are proved.
        tube: Squares that cover it.
    """
    boxes = 0
    for conditions in _proposals(field, outer, tube):
        for _ in range(ATTEMPTS):
            falls, shape = _prove(field, conditions, tube)
            boxes += falls.evaluated
            if shape is not None:
                return Inner(conditions, shape, boxes)
            level = _level_of_obstacle(field, conditions, falls)
            c_in = conditions.c_out if level is None else _above(level)
            if c_in >= conditions.c_out / 2:
                break
            conditions = replace(conditions, c_in=c_in)
    return None


def known_inner(
    conditions: Conditions | None,
) -> Callable[[GuidingField, Conditions, Boxes], Inner | None]:
    """Returns what proves given conditions of an inner tube, in place of `find_inner`."""

    def find(field: GuidingField, outer: Conditions, tube: Boxes) -> Inner | None:
        if conditions is None:
            return None
        falls, shape = _prove(field, conditions, tube)
        return None if shape is None else Inner(conditions, shape, falls.evaluated)

    return find


def _prove(
    field: GuidingField, conditions: Conditions, tube: Boxes
) -> tuple[Division, Shape | None]:
    """Proves that V' falls from {V' <= c_out'}, which has to hold the tube, to c_in'."""
    c, squares = conditions, Squares.of(field)
    levels = MixtureModel(mixture_of(field, c.sigma), c.lowest)
    basin = levels.squares_below(c.c_out, squares.everything, squares.ring)
    falls = Decrease(field, levels, c.c_in, c.c_out, c.alpha, c.share).prove(
        basin, squares.last
    )
    holds_tube = levels.level_range(tube)[1].max() <= c.c_out
    is_inside = np.abs(basin.centers).max() + squares.ring < HALF_WIDTH
    if not (falls.proved and holds_tube and is_inside):
        return falls, None
    return falls, shape_of_band(levels, c.c_in, c.c_out, squares.thin)


def _proposals(field: GuidingField, outer: Conditions, tube: Boxes) -> Iterator[Conditions]:
    """Gives conditions, of the thinnest tube first, by samples."""
    found = []
    for ratio in RATIOS:
        mixture = mixture_of(field, ratio * field.sigma)
        levels = MixtureModel(mixture, lowest_of(mixture))
        c_out = float(levels.level_range(tube)[1].max())
        c_in = _lowest_level(field, levels, c_out, outer.alpha, tube)
        if c_in < c_out / 2:
            conditions = replace(
                outer, sigma=mixture.sigma, lowest=levels.lowest, c_in=c_in, c_out=c_out
            )
            found.append((mixture.sigma * np.sqrt(c_in), conditions))
    yield from (conditions for _, conditions in sorted(found, key=lambda pair: pair[0]))


def _lowest_level(
    field: GuidingField, levels: MixtureModel, c_out: float, alpha: float, tube: Boxes
) -> float:
    """Returns a level above which V' was seen to fall up to `c_out`."""
    rng = np.random.default_rng(0)
    chosen = rng.integers(len(tube), size=NUM_POINTS)
    z = tube.centers[chosen] + tube.half[chosen, None] * rng.uniform(-1, 1, (NUM_POINTS, 2))
    V = levels.level_range(Boxes(z, np.zeros(len(z))))[0]
    V_dot = -(levels.mixture.score(z) * field(field.cloud.denormalize(z))).sum(axis=1)
    rising = V[(c_out >= V) & (V_dot > -2 * alpha)]
    return _above(float(rising.max(initial=0.0)))


def _above(level: float) -> float:
    """Returns a level that leaves out one at which V' does not fall."""
    return (1 + LEVEL_MARGIN) * level + LEVEL_FLOOR


def _level_of_obstacle(
    field: GuidingField, conditions: Conditions, falls: Division
) -> float | None:
    """Returns V' where the proof ended; None: not because V' does not fall."""
    if falls.proved:
        return None
    point = falls.counterexample
    if point is None:
        point = falls.undecided.centers[0]
    levels = MixtureModel(mixture_of(field, conditions.sigma), conditions.lowest)
    return float(levels.level_range(Boxes(point[None], np.zeros(1)))[0][0])
