"""All zeros of a field in a square or a cube, proved: none is missed, none is told twice."""

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
from sgvf_drake.lyapunov import KnownZero, KnownZeros, PartName

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
"""Half-side of the square or cube that is searched, normalised units: the field's box, and more
than rounding can change of it."""

# Half-sides of the first squares, and of those that are divided further only where few of them
# are left, as at a zero that is nearly double and not along a line of zeros; and of the last.
FIRST, FINE, LAST = 2.0**-3, 2.0**-10, 2.0**-24
MOST_FINE = 1_000
# What would need more cubes than this is left undecided, as a line of zeros in space is.
MOST_CUBES = 3_000_000

# The facts of a square, (2 d + 2,): a direction in which m points all over it, (d,), or the one
# zero near it, by the centre of an enclosure, (d,), and its half-side, and by its index.
RADIUS, INDEX = -2, -1


def _directions(facts: FloatArray) -> FloatArray:
    """Returns the directions, (n, d)."""
    return facts[:, : facts.shape[1] // 2 - 1]


def _points(facts: FloatArray) -> FloatArray:
    """Returns the centres of enclosures, (n, d)."""
    return facts[:, facts.shape[1] // 2 - 1 : RADIUS]


@dataclass(frozen=True, eq=False)
class EnclosedZero(KnownZero):
    """A zero of a field; all of this is proved; see `KnownZero`.

    Its `point` is the centre of a square or a cube that holds the zero and no other; its `kind`
    is not told more finely than `source`, `sink`, `saddle`, `focus` and `unknown`, and not at
    all in more than three dimensions.

    Attributes:
        radius: Half-side of the square.
    """

    radius: float


@dataclass(frozen=True, eq=False)
class ZeroList(KnownZeros[EnclosedZero]):
    """The zeros of a field in a square or a cube, which do not overlap; see `KnownZeros`.

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
    """Encloses all zeros of a field in its box, with a proof that there are no others.

    Args:
        field: The field, of closed paths, with smooth activations.
        part: Whose zeros: those of m, of the raw score or of the tangent network.

    Raises:
        ConfigurationError: The field is a directed one or one of open paths, or nothing bounds
            its derivatives.
    """
    check_position_alone(field)
    if len(field.ends) or not has_dual(field):
        raise ConfigurationError("zeros are enclosed of smooth fields of closed paths only")
    function = _Part(field, part)
    rounding = SLACK * (HALF_WIDTH + np.abs(field.cloud.center).max() / field.cloud.unit_length)
    # Enclosures are as much wider as their centres and sides may move in the user's unit.
    found = _Vanishing(function, HALF_WIDTH, 2 * rounding).prove(field.dim)
    isolated, ambiguous = _distinct(found)
    corner = np.full(field.dim, HALF_WIDTH)
    zeros = ZeroList(
        box=(field.cloud.denormalize(-corner), field.cloud.denormalize(corner)),
        zeros=_described(field, function, isolated, rounding),
        undecided=len(found.undecided) + ambiguous,
        winding_number=(
            proved_winding_number(found.boxes, _directions(found.facts), HALF_WIDTH)
            if field.dim == 2
            else None
        ),
        boxes=found.evaluated,
        dim=field.dim,
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

    def prove(self, dim: int) -> Division:
        """Answers it over squares, or cubes, that cover everything."""
        most = np.inf if dim == 2 else MOST_CUBES
        found = divide(_grid(self.half, FIRST, dim), self._ask, _never, FINE, most)
        if not 0 < len(found.undecided) <= MOST_FINE:
            return found
        rest = most - found.evaluated
        finer = divide(found.undecided, self._ask, _never, LAST, rest)
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
        facts = np.full((len(boxes), 2 * boxes.centers.shape[1] + 2), np.nan)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            m = self.function.model(boxes.patches)
            _directions(facts)[:] = directions_of(m)
            asked = np.isnan(facts[:, 0]) & may_be_isolated(m) & ~at_border(boxes, self.half)
            if asked.any():
                facts[asked] = self._isolated(boxes[asked])
        decided = np.asarray(~np.isnan(facts[:, [0, INDEX]]).all(axis=1))
        return Answer(decided, facts, len(boxes))

    def _isolated(self, boxes: Boxes) -> FloatArray:
        """Returns the facts of squares near which a zero may be."""
        found = isolate(self.function, boxes, self.margin)
        nothing = np.full_like(boxes.centers, np.nan)
        facts = np.column_stack([nothing, found.points, found.radius, found.index])
        facts[~found.is_one] = np.nan
        return facts


def _never(points: FloatArray) -> BoolArray:
    """No point speaks against a list of zeros."""
    return np.zeros(len(points), bool)


def _grid(half: float, part: float, dim: int = 2) -> Boxes:
    """Returns the squares, or cubes, of a half-side that one around the origin is made of."""
    middles = part * (2 * np.arange(round(half / part)) + 1) - half
    centers = np.stack(np.meshgrid(*[middles] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return Boxes(centers, np.full(len(centers), part))


def _distinct(found: Division) -> tuple[FloatArray, int]:
    """Returns the facts of different zeros, and how many may be another or the same.

    Neighbours find the same zero: it is, where the enclosure of one is inside of the enlarged
    square of the other, which holds one zero only.
    """
    rows, points = np.flatnonzero(~np.isnan(found.facts[:, INDEX])), _points(found.facts)
    kept: list[int] = []
    ambiguous = 0
    for row in rows:
        point, radius = points[row], found.facts[row, RADIUS]
        apart = np.abs(points[kept] - point).max(axis=1)
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
    z, half = _points(facts), facts[:, RADIUS]
    points, radius = field.cloud.denormalize(z), (half - rounding) * field.cloud.unit_length
    kinds = _kinds(function.dual(Boxes(z, half).patches), facts[:, INDEX])
    return tuple(
        EnclosedZero(point, int(index), *kind, float(side))
        for point, side, index, kind in zip(points, radius, facts[:, INDEX], kinds, strict=True)
    )


def _kinds(m: DualModel, indices: FloatArray) -> list[tuple[str, bool | None]]:
    """Returns what zeros are and whether they are stable, by J on their enclosures."""
    dim = len(m.slopes)
    along = np.broadcast_to(np.eye(dim)[:, None], (dim, len(indices), dim))
    J = [[slope.weighted(axis) for slope in m.slopes] for axis in along]
    signs = {2: _signs_in_plane, 3: _signs_in_space}.get(dim)
    if signs is None:
        return [("unknown", None)] * len(indices)
    return [_kind(*each) for each in zip(*signs(J, indices), strict=True)]


def _signs_in_plane(
    J: list[list[TaylorModel]], indices: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns what `_kind` wants, (n,) each: by lambda^2 - tr J lambda + det J."""
    (a, b), (c, d) = J
    difference = a - d
    discriminant = difference * difference + (b * c).scaled(4.0)
    return np.where(indices < 0, np.nan, _side(a + d)), _side(discriminant)


def _signs_in_space(
    J: list[list[TaylorModel]], indices: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns what `_kind` wants, (n,) each: by lambda^3 - t lambda^2 + s lambda - det J.

    By Routh and Hurwitz, all roots are left of zero where det J, t and t s - det J are below
    it, and right of it where those are above.  They are on both sides where det J has another
    sign than one of the other two.
    """

    def minor(a: int, b: int, c: int, d: int) -> TaylorModel:
        """The minor of rows a and b and columns c and d."""
        return J[a][c] * J[b][d] - J[a][d] * J[b][c]

    t = J[0][0] + J[1][1] + J[2][2]
    s = minor(0, 1, 0, 1) + minor(0, 2, 0, 2) + minor(1, 2, 1, 2)
    det = (
        J[0][0] * minor(1, 2, 1, 2) + J[0][1] * minor(1, 2, 2, 0) + J[0][2] * minor(1, 2, 0, 1)
    )
    ts = t * s
    same = np.stack([indices * _side(t), indices * _side(ts - det)])
    side = np.where((same > 0).all(axis=0), indices, 0.0)
    cubes = (t * t * t * det + s * s * s).scaled(4.0)
    discriminant = ts * ts + (ts * det).scaled(18.0) - cubes - (det * det).scaled(27.0)
    return np.where((same < 0).any(axis=0), np.nan, side), _side(discriminant)


def _kind(side: float, discriminant: float) -> tuple[str, bool | None]:
    """Returns the kind of a zero and its stability.

    Args:
        side: The sign of the real parts of all eigenvalues; NaN: they have both; 0: not known.
        discriminant: The sign of that of their polynomial, negative where two of them are
            complex; 0: not known.
    """
    if np.isnan(side):
        return "saddle", False
    if side == 0:
        return "unknown", None
    stable = bool(side < 0)
    if discriminant == 0:
        return "unknown", stable
    if discriminant < 0:
        return "focus", stable
    return "sink" if stable else "source", stable


def _side(function: TaylorModel) -> FloatArray:
    """Returns the signs (n,) of one function over squares; 0: none is known."""
    return np.where(function.lower > 0, 1.0, np.where(function.upper < 0, -1.0, 0.0))[:, 0]
