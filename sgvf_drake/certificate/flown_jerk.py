"""What a field asks of a vehicle between walls: acceleration, turn rate, unknown jerk.

A vehicle whose velocity is v = v0 (m(p) + s) is fed forward a = v0 J v, and takes its rate to
be w x a with w = (v x a) / (|v|^2 + slow^2).  The rate is v0 m''[v, v] + v0 J v', so that at
v' = a what it does not know is

    eta = v0 m''[v, v] + v0 J a - w x a.

In normalised units, with n = m + s, this is v0^3 / U^2 times
m''[n, n] + J J n - omega (J n)^perp, with omega = (n x J n) / (|n|^2 + (slow / v0)^2).  It is
bounded by Taylor models over the products of patches of the plane with squares of s.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import RECIPROCAL
from sgvf_drake.certificate.field_model import ExactField, model_field
from sgvf_drake.certificate.jet_model import jet_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.certificate.tube import Tube, normal
from sgvf_drake.certificate.tube_cells import Answer, Parts, divide, join
from sgvf_drake.certificate.walls import Walls

# Cells are halved so often, at most: what is asked for is decided before, or is not so.
HALVINGS = 14
# Second derivatives are bounded over no larger patches, normalised: it would say nothing.
LARGEST_PATCH = 0.03
# Parts are halved until a bound of a speed is such a part of that at the middle, or so often.
SHARP, FOR_SPEED = 0.8, 2
# Squares of s on each axis.
SQUARES = 2
JERK, ACCELERATION, TURN, ALONG, GROWTH, SLOPE, LEAST_SPEED, MOST_SPEED = range(8)


@dataclass(frozen=True)
class FlownBounds:
    """Suprema over a region and all |s| <= `error`, normalised.

    Attributes:
        error: The largest |s|, a part of the commanded speed.
        centre: c, about which J is bounded.
        jerk: Of |eta|, times U^2 / v0^3.
        acceleration: Of |J n|.
        turn: Of |omega|.
        along: Of |n . J n|.
        growth: Of the spectral norm of J - c I.
        slope: Of the spectral norm of J.
        least_speed: Infimum of |m|.
        most_speed: Supremum of |m|.
        patches: Over how many patches the field was bounded.
    """

    error: float
    centre: float
    jerk: float
    acceleration: float
    turn: float
    along: float
    growth: float
    slope: float
    least_speed: float
    most_speed: float
    patches: int


def region(tube: Tube, walls: Walls, pairs: int) -> Parts:
    """Returns the cells of a closed tube in the plane and of so many pairs of walls around."""
    middle, half = tube.rows[:-1, 0], tube.rows[:-1, 1]
    cells = [tube.cells]
    for side in (1, -1):
        inner = middle + side * half
        for pair in range(pairs):
            outer = walls.polygons(side)[pair]
            rows = np.stack([(inner + outer) / 2, side * (outer - inner) / 2], axis=1)
            cells.append(Parts(rows, np.roll(rows, -1, axis=0), np.arange(len(rows))))
            inner = outer
    return join(cells)


def bound_flown(
    field: ExactField,
    cells: Parts,
    *,
    error: float,
    slow: float,
    centre: float,
    target: float,
) -> FlownBounds | None:
    """Bounds what a field asks of a vehicle over cells in the plane.

    Args:
        field: m.
        cells: The cells.
        error: The largest |s|.
        slow: `slow` / v0.
        centre: c.
        target: What the jerk is to be at most: a patch on which it may be more is divided.

    Returns:
        The bounds; None: the jerk is not proved to be below the target.
    """
    ask = partial(_ask, field, error, slow, centre, target)
    found = divide(cells, ask, Parts.longer_halves, halvings=HALVINGS)
    if len(found.open_cells):
        return None
    most = found.facts.max(axis=0).tolist()
    return FlownBounds(
        error=error,
        centre=centre,
        jerk=most[JERK],
        acceleration=most[ACCELERATION],
        turn=most[TURN],
        along=most[ALONG],
        growth=most[GROWTH],
        slope=most[SLOPE],
        least_speed=float(found.facts[:, LEAST_SPEED].min()),
        most_speed=most[MOST_SPEED],
        patches=found.asked,
    )


def _ask(
    field: ExactField,
    error: float,
    slow: float,
    centre: float,
    target: float,
    parts: Parts,
    depth: int,
) -> Answer:
    hulls = parts.hulls
    size = np.linalg.norm(hulls.axes, axis=1).max(axis=1)
    small = np.asarray(size <= LARGEST_PATCH)
    facts = np.full((len(parts), 8), np.inf)
    if small.any():
        facts[small] = _facts(field, parts[small], error, slow, centre)
    decided = small & (facts[:, JERK] <= target) & np.isfinite(facts).all(axis=1)
    return Answer(decided, np.zeros(len(parts), bool), facts)


def _facts(
    field: ExactField, parts: Parts, error: float, slow: float, centre: float
) -> FloatArray:
    jet = jet_field(field, parts.hulls)
    facts = np.zeros((len(parts), 8))
    J = [_entries(slope) for slope in jet.first.slopes]
    shifted = [[J[k][i].shifted(-centre * (i == k)) for i in (0, 1)] for k in (0, 1)]
    facts[:, GROWTH], facts[:, SLOPE] = _norms(shifted), _norms(J)
    square = jet.value.dot(jet.value)
    facts[:, LEAST_SPEED] = np.sqrt(np.maximum(square.lower[:, 0], 0)) * (1 - SLACK)
    facts[:, MOST_SPEED] = np.sqrt(square.upper[:, 0]) * (1 + SLACK)
    wide = [_with_squares(model) for model in (jet.value, *jet.first.slopes, *jet.second)]
    half = error / SQUARES
    for middle in (2 * np.arange(SQUARES) + 1 - SQUARES) * half:
        for across in (2 * np.arange(SQUARES) + 1 - SQUARES) * half:
            n = wide[0] + _square(wide[0], (middle, across), half)
            found = _of_velocity(n, wide[1:3], wide[3:], slow)
            facts[:, : len(found)] = np.maximum(facts[:, : len(found)], np.transpose(found))
    return facts


def _of_velocity(
    n: TaylorModel, J: list[TaylorModel], H: list[TaylorModel], slow: float
) -> list[FloatArray]:
    """Returns bounds of the jerk, |J n|, |omega| and |n . J n|, (patches,) each."""
    x, y = _entries(n)
    a = x * J[0] + y * J[1]
    ax, ay = _entries(a)
    speed = n.dot(n).shifted(slow**2)
    least = float(np.maximum(speed.lower.min(), 0))
    omega = (x * ay - y * ax) * speed.apply(RECIPROCAL, least=least)
    square = (x * x) * H[0] + (x * y).scaled(2.0) * H[1] + (y * y) * H[2]
    turned = ay.scaled(-1.0).joined(ax)
    eta = square + ax * J[0] + ay * J[1] - omega * turned
    along = n.dot(a)
    return [_length(eta), _length(a), _size(omega), _size(along)]


def _entries(model: TaylorModel) -> list[TaylorModel]:
    return [model.functions(slice(i, i + 1)) for i in (0, 1)]


def _size(model: TaylorModel) -> FloatArray:
    return np.asarray(np.maximum(-model.lower[:, 0], model.upper[:, 0]))


def _length(model: TaylorModel) -> FloatArray:
    """Returns bounds of the lengths of vectors, the better of two ways."""
    parts = np.hypot(*(_size(entry) for entry in _entries(model)))
    whole = np.sqrt(np.maximum(model.dot(model).upper[:, 0], 0))
    return np.asarray((1 + SLACK) * np.minimum(parts, whole))


def _norms(entries: list[list[TaylorModel]]) -> FloatArray:
    """Returns bounds of the spectral norms of matrices of models."""
    low, high = (
        np.stack([[getattr(one, side)[:, 0] for one in row] for row in entries])
        for side in ("lower", "upper")
    )
    middle, off = (low + high) / 2, (1 + SLACK) * (high - low) / 2
    a, b, c, d = middle.reshape(4, -1)
    # Of a matrix in the plane: by its parts that turn and reflect.
    norm = np.hypot(a + d, b - c) / 2 + np.hypot(a - d, b + c) / 2
    size = np.abs(middle).sum(axis=(0, 1))
    return np.asarray(norm + np.sqrt((off**2).sum(axis=(0, 1))) + 4 * SLACK * size)


def _with_squares(model: TaylorModel) -> TaylorModel:
    """Returns models over patches of two parameters as ones of four, of which two are idle."""
    value, first, second, a, b, c = np.moveaxis(model.parts, 1, 0)
    nothing = np.zeros_like(value)
    rows = [value, first, second, nothing, nothing, a, b, nothing, nothing, c]
    return TaylorModel(np.stack(rows + 5 * [nothing], axis=1), model.remainder)


def _square(like: TaylorModel, middle: tuple[float, float], half: float) -> TaylorModel:
    """Returns the model of a vector in a square, by the last two of four parameters."""
    parts = np.zeros_like(like.parts)
    parts[:, 0] = middle
    parts[:, 3, 0] = parts[:, 4, 1] = half
    return TaylorModel(parts, np.zeros_like(like.remainder))


def least_progress(field: ExactField, cells: Parts) -> float:
    """Returns at least how fast m crosses the lines from wall to wall of cells, normalised.

    A robot with x' = m + s goes on from section to section where |s| is below that.
    """
    found = divide(cells, partial(_ask_progress, field), Parts.longer_halves, halvings=8)
    return 0.0 if len(found.open_cells) else float(found.facts.min())


def _ask_progress(field: ExactField, parts: Parts, depth: int) -> Answer:
    _, across = parts.columns
    crossed = normal([across]).dot(model_field(field, parts.patches))
    longest = np.linalg.norm([parts.start[:, 1], parts.end[:, 1]], axis=2).max(axis=0)
    speed = crossed.lower[:, 0] / longest * (1 - SLACK)
    sharp = crossed.lower[:, 0] >= SHARP * crossed.value[:, 0]
    decided = (speed > 0) & (sharp | (depth >= FOR_SPEED))
    return Answer(decided, crossed.upper[:, 0] <= 0, speed[:, None])
