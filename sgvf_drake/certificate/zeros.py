"""All zeros of a planar field in a square, proved: none is missed and none is told twice."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Answer, Boxes, Division, divide
from sgvf_drake.certificate.field_model import DUAL, TAYLOR, Algebra, has_dual, simplify
from sgvf_drake.certificate.isolation import (
    ENLARGED,
    BoundedMap,
    directions_of,
    isolate,
    may_be_isolated,
)
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import DualModel, Model, TaylorModel
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField, check_position_alone
from sgvf_drake.lyapunov import PartName, PlanarZero, PlanarZeros

# Of neighbouring directions that are farther apart, in radians, rounding might tell wrongly on
# which side of each other they are.
LARGEST_TURN = 3.0


def proved_winding_number(boxes: Boxes, directions: FloatArray, half: float) -> int | None:
    """Returns how often m turns along the border of a square around the origin.

    Where m . u > 0 on a square and m . w > 0 on the next one, m at their common point is less
    than a quarter turn away from both.  So from one such point to the next m turns by what u,
    w, ... turn by, each the short way around, but for its angles to the first and the last;
    and around the border these are the same.

    Args:
        boxes: Squares of a dyadic grid in the square, without overlap.
        directions: (n, 2) u of each, NaN where none is known.
        half: Half-side of the square.

    Returns:
        The number, counter-clockwise; None: it is not proved, or they do not cover the border.
    """
    sides = _sides(boxes, half)
    if any(boxes.half[side].sum() != half for side in sides):
        return None
    u = directions[np.concatenate(sides)]
    w = np.roll(u, -1, axis=0)
    turns = np.arctan2(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0], (u * w).sum(axis=1))
    # NaN is not either.
    if not (np.abs(turns) <= LARGEST_TURN).all():
        return None
    return round(float(turns.sum()) / (2 * np.pi))


def at_border(boxes: Boxes, half: float) -> BoolArray:
    """Tells which squares (n,) of a dyadic grid have a side on the border of a square."""
    return np.asarray(np.abs(boxes.centers).max(axis=1) + boxes.half == half)


def _sides(boxes: Boxes, half: float) -> list[IntArray]:
    """Returns the squares along each side, counter-clockwise; those in corners are on two."""
    x, y = boxes.centers.T
    sides = []
    for outward, forward in ((-y, x), (x, y), (y, -x), (-x, -y)):
        side = np.flatnonzero(outward + boxes.half == half)
        sides.append(side[np.argsort(forward[side])])
    return sides


HALF_WIDTH = 5.125
"""Half-side of the square that is searched, normalised units: the field's box, and more than
rounding can change of it."""

# Half-sides of the first squares, and of those that are divided further only where few of them
# are left, as at a zero that is nearly double and not along a line of zeros; and of the last.
FIRST, FINE, LAST = 2.0**-3, 2.0**-10, 2.0**-24
MOST_FINE = 1_000

# The facts of a square: a direction in which m points all over it, or the one zero near it, by
# the centre and the half-side of an enclosure and its index.
DIRECTION, POINT, RADIUS, INDEX = slice(0, 2), slice(2, 4), 4, 5


@dataclass(frozen=True, eq=False)
class EnclosedZero(PlanarZero):
    """A zero of a planar field; all of this is proved; see `PlanarZero`.

    Its `point` is the centre of a square that holds the zero and no other; its `kind` is not
    told more finely than `source`, `sink`, `saddle`, `focus` and `unknown`.

    Attributes:
        radius: Half-side of the square.
    """

    radius: float


@dataclass(frozen=True, eq=False)
class ZeroList(PlanarZeros[EnclosedZero]):
    """The zeros of a field in a square, which do not overlap; see `PlanarZeros`.

    What is `undecided` are squares that may hold further zeros, or the same ones.

    Attributes:
        box: Lower and upper corner of the square, which holds the field's box.
        boxes: Number of squares over which the field was bounded.
    """

    box: tuple[FloatArray, FloatArray]
    boxes: int

    @property
    def complete(self) -> bool:
        """Whether it is proved that there are no others."""
        return self.undecided == 0


def enclose_zeros(field: GuidingField, part: PartName = "guiding") -> ZeroList:
    """Encloses all zeros of a planar field in its box, with a proof that there are no others.

    Args:
        field: The field, of closed paths, with smooth activations.
        part: Whose zeros: those of m, of the raw score or of the tangent network.

    Raises:
        ConfigurationError: The field is not planar, or nothing bounds its derivatives.
    """
    check_position_alone(field)
    if field.dim != 2:
        raise ConfigurationError(f"zeros are enclosed of planar fields, not in {field.dim}-D")
    if len(field.ends) or not has_dual(field):
        raise ConfigurationError("zeros are enclosed of smooth fields of closed paths only")
    function = _Part(field, part)
    rounding = SLACK * (HALF_WIDTH + np.abs(field.cloud.center).max() / field.cloud.unit_length)
    # Enclosures are as much wider as their centres and sides may move in the user's unit.
    found = _Vanishing(function, HALF_WIDTH, 2 * rounding).prove()
    isolated, ambiguous = _distinct(found)
    corner = np.full(2, HALF_WIDTH)
    zeros = ZeroList(
        box=(field.cloud.denormalize(-corner), field.cloud.denormalize(corner)),
        zeros=_described(field, function, isolated, rounding),
        undecided=len(found.undecided) + ambiguous,
        winding_number=proved_winding_number(
            found.boxes, found.facts[:, DIRECTION], HALF_WIDTH
        ),
        boxes=found.evaluated,
    )
    # Poincare and Hopf.
    assert not zeros.complete or zeros.winding_number in (None, zeros.index_sum)
    return zeros


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of a field; of m, a positive multiple.

    Attributes:
        field: The field.
        name: Which part it is.
    """

    field: GuidingField
    name: PartName

    def model(self, patches: Patches) -> TaylorModel:
        """See `BoundedMap`."""
        return self._in(TAYLOR, patches)

    def dual(self, patches: Patches) -> DualModel:
        """See `BoundedMap`."""
        return self._in(DUAL, patches)

    def _in(self, algebra: Algebra[Model], patches: Patches) -> Model:
        S, N = algebra.score_and_tangent(self.field, patches)
        parts = {"score": S, "tangent": N}
        return parts.get(self.name) or simplify(self.field.composition, S, N)


@dataclass(frozen=True, eq=False)
class _Vanishing:
    """The question where m vanishes: nowhere in a square, or at one point near it.

    Attributes:
        function: m.
        half: Half-side of all that is searched.  At its border no zero is looked for, so that
            an enlarged square is inside, and m is known to point somewhere all along.
        margin: See `isolate`.
    """

    function: BoundedMap
    half: float
    margin: float

    def prove(self) -> Division:
        """Answers it over squares that cover everything."""
        found = divide(_grid(self.half, FIRST), self._ask, _never, FINE)
        if not 0 < len(found.undecided) <= MOST_FINE:
            return found
        finer = divide(found.undecided, self._ask, _never, LAST)
        return Division(
            boxes=Boxes(
                np.concatenate([found.boxes.centers, finer.boxes.centers]),
                np.concatenate([found.boxes.half, finer.boxes.half]),
            ),
            facts=np.concatenate([found.facts, finer.facts]),
            evaluated=found.evaluated + finer.evaluated,
            counterexample=None,
            undecided=finer.undecided,
        )

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 6), np.nan)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            m = self.function.model(boxes.patches)
            facts[:, DIRECTION] = directions_of(m)
            asked = np.isnan(facts[:, 0]) & may_be_isolated(m) & ~at_border(boxes, self.half)
            if asked.any():
                facts[asked] = self._isolated(boxes[asked])
        decided = ~np.isnan(facts[:, [0, INDEX]]).all(axis=1)
        return Answer(decided, facts, len(boxes))

    def _isolated(self, boxes: Boxes) -> FloatArray:
        """Returns the facts (n, 6) of squares near which a zero may be."""
        found = isolate(self.function, boxes, self.margin)
        nothing = np.full_like(boxes.centers, np.nan)
        facts = np.column_stack([nothing, found.points, found.radius, found.index])
        facts[~found.is_one] = np.nan
        return facts


def _never(points: FloatArray) -> BoolArray:
    """No point speaks against a list of zeros."""
    return np.zeros(len(points), bool)


def _grid(half: float, part: float) -> Boxes:
    """Returns the squares of a half-side that a square around the origin is made of."""
    middles = part * (2 * np.arange(round(half / part)) + 1) - half
    centers = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1).reshape(-1, 2)
    return Boxes(centers, np.full(len(centers), part))


def _distinct(found: Division) -> tuple[FloatArray, int]:
    """Returns the facts (k, 6) of different zeros, and how many may be another or the same.

    Neighbours find the same zero: it is, where the enclosure of one is inside of the enlarged
    square of the other, which holds one zero only.
    """
    rows = np.flatnonzero(~np.isnan(found.facts[:, INDEX]))
    kept: list[int] = []
    ambiguous = 0
    for row in rows:
        point, radius = found.facts[row, POINT], found.facts[row, RADIUS]
        apart = np.abs(found.facts[kept, POINT] - point).max(axis=1)
        from_center = np.abs(found.boxes.centers[kept] - point).max(axis=1)
        clear = (1 + SLACK) * (from_center + radius) < ENLARGED * found.boxes.half[kept]
        if clear.any():
            continue
        if (apart > (1 + SLACK) * (radius + found.facts[kept, RADIUS])).all():
            kept.append(int(row))
        else:
            ambiguous += 1
    return found.facts[kept], ambiguous


def _described(
    field: GuidingField, function: BoundedMap, facts: FloatArray, rounding: float
) -> tuple[EnclosedZero, ...]:
    """Returns zeros in the unit of the waypoints, with their kinds."""
    z, half = facts[:, POINT], facts[:, RADIUS]
    points, radius = field.cloud.denormalize(z), (half - rounding) * field.cloud.unit_length
    kinds = _kinds(function.dual(Boxes(z, half).patches), facts[:, INDEX])
    return tuple(
        EnclosedZero(point, int(index), *kind, float(side))
        for point, side, index, kind in zip(points, radius, facts[:, INDEX], kinds, strict=True)
    )


def _kinds(m: DualModel, indices: FloatArray) -> list[tuple[str, bool | None]]:
    """Returns what zeros are and whether they are stable, by J on their enclosures."""
    along_x, along_y = np.broadcast_to(np.eye(2)[:, None], (2, len(indices), 2))
    (a, c), (b, d) = ((slope.weighted(along_x), slope.weighted(along_y)) for slope in m.slopes)
    trace, difference = a + d, a - d
    # Of lambda^2 - tr J lambda + det J.
    discriminant = difference * difference + (b * c).scaled(4.0)
    return [
        ("saddle", False) if index < 0 else _kind(trace_side, discriminant_side)
        for index, trace_side, discriminant_side in zip(
            indices, _side(trace), _side(discriminant), strict=True
        )
    ]


def _kind(trace: float, discriminant: float) -> tuple[str, bool | None]:
    """Returns the kind of a zero of index one and its stability, by signs; 0: not known."""
    if trace == 0:
        return "unknown", None
    stable = bool(trace < 0)
    if discriminant == 0:
        return "unknown", stable
    if discriminant < 0:
        return "focus", stable
    return "sink" if stable else "source", stable


def _side(function: TaylorModel) -> FloatArray:
    """Returns the signs (n,) of one function over squares; 0: none is known."""
    return np.where(function.lower > 0, 1.0, np.where(function.upper < 0, -1.0, 0.0))[:, 0]
