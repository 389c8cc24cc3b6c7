"""What a field asks of a vehicle between walls: how it bends, and how that changes.

A vehicle with the velocity v is commanded U = v0 m(p), and the law takes the derivatives of U
along v from differences between p - h v, p and p + h v.  These are means of second derivatives
of m over the places between, with weights that are the same before and behind p: so they are
off by what is not linear in the second derivatives there.  All is bounded by Taylor models over
patches that are grown by the reach h |v|, and normalised as the field is.  On each the velocity
is v0 (n + s) with n = m at its centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.field_model import ExactField, model_field
from sgvf_drake.certificate.jet_model import jet_field, pairs
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.certificate.tube import Tube, normal
from sgvf_drake.certificate.tube_cells import ROUNDING, Answer, Parts, divide, join
from sgvf_drake.certificate.walls import Walls

# Cells are halved so often, and there are so many at once, at most: what is asked for is
# decided before, or costs minutes.
HALVINGS, AT_MOST = 16, 60_000
# Second derivatives are bounded over no larger patches, normalised: it would say nothing.
LARGEST_PATCH = 0.03
# Parts are halved until a bound of a speed is such a part of that at the middle, or so often.
SHARP, FOR_SPEED = 0.8, 2
(
    ALONG,
    ALONG_OFF,
    ALONG_CHANGE,
    BEND,
    BEND_OFF,
    ACCELERATION,
    SLOPE,
    MOST_SPEED,
) = range(8)


@dataclass(frozen=True)
class FlownBounds:
    """Bounds over a region and all n with |n - m| <= `error`, normalised.

    Attributes:
        error: The largest |n - m|, a part of the commanded speed.
        reach: How far the law looks ahead and back, at most.
        along: Bounds |m''[n, n]|.
        along_off: Bounds how far m''[n, n] is from its means over the reach on both sides.
        along_change: Bounds how far its mean over the reach ahead is from that behind.
        bend: Bounds m'', as the root of the sum of squares of the second derivatives.
        bend_off: Bounds in the same norm how far m'' is from its means over both sides.
        acceleration: Bounds |J n|.
        slope: Bounds the spectral norm of J.
        most_speed: Bounds |m|.
        patches: Over how many patches the field was bounded.
    """

    error: float
    reach: float
    along: float
    along_off: float
    along_change: float
    bend: float
    bend_off: float
    acceleration: float
    slope: float
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
    reach: float,
    target: float,
    at_most: int = AT_MOST,
) -> FlownBounds | None:
    """Bounds what a field asks of a vehicle over cells in the plane.

    Args:
        field: m.
        cells: The cells.
        error: The largest |n - m|.
        reach: How far the law looks ahead and back.
        target: What `along_change` is to be at most: a patch on which it may be more is
            divided.
        at_most: Over how many patches at once the field is bounded.

    Returns:
        The bounds; None: the second derivatives are not proved to change by less.
    """
    ask = partial(_ask, field, error, reach, target)
    found = divide(cells, ask, Parts.longer_halves, halvings=HALVINGS, at_most=at_most)
    if len(found.open_cells):
        return None
    most = found.facts.max(axis=0).tolist()
    return FlownBounds(
        error=error,
        reach=reach,
        along=most[ALONG],
        along_off=most[ALONG_OFF],
        along_change=most[ALONG_CHANGE],
        bend=most[BEND],
        bend_off=most[BEND_OFF],
        acceleration=most[ACCELERATION],
        slope=most[SLOPE],
        most_speed=most[MOST_SPEED],
        patches=found.asked,
    )


def _ask(
    field: ExactField, error: float, reach: float, target: float, parts: Parts, depth: int
) -> Answer:
    hulls = parts.hulls
    size = np.linalg.norm(hulls.axes, axis=1).max(axis=1)
    small = np.asarray(size <= LARGEST_PATCH)
    facts = np.full((len(parts), 8), np.inf)
    if small.any():
        facts[small] = flown_facts(field, hulls[small], error, reach)
    decided = small & (facts[:, ALONG_CHANGE] <= target) & np.isfinite(facts).all(axis=1)
    return Answer(decided, np.zeros(len(parts), bool), facts)


def flown_facts(field: ExactField, patches: Patches, error: float, reach: float) -> FloatArray:
    """Returns what `FlownBounds` bounds over each of n patches of the plane, (n, 8)."""
    moved = _within(patches, reach)
    patches = Patches(patches.centers, patches.axes * (1 + moved)[:, None])
    jet, moving = jet_field(field, patches), _Moving(patches, reach)
    m, J = jet.value, jet.first.slopes
    x, y = n = m.value.T
    rho = error + np.hypot(*np.maximum(m.upper - m.value, m.value - m.lower).T)
    more = (2 * np.hypot(x, y) + rho) * rho
    second, acceleration = _along(jet.second, (x * x, 2 * x * y, y * y)), _along(J, n)
    facts = np.empty((len(m.value), 8))
    facts[:, BEND] = _size([_range(model) for model in jet.second])
    facts[:, BEND_OFF] = _size([moving.off(model) for model in jet.second])
    change = _size([moving.change(model) for model in jet.second])
    facts[:, ALONG] = _length(_range(second)) + more * facts[:, BEND]
    facts[:, ALONG_OFF] = _length(moving.off(second)) + more * facts[:, BEND_OFF]
    facts[:, ALONG_CHANGE] = _length(moving.change(second, n, rho)) + more * change
    facts[:, SLOPE] = _norms(J)
    facts[:, ACCELERATION] = _length(_range(acceleration)) + rho * facts[:, SLOPE]
    facts[:, MOST_SPEED] = np.sqrt(m.dot(m).upper[:, 0])
    return np.asarray((1 + 16 * SLACK) * facts)


def _within(patches: Patches, reach: float | FloatArray) -> FloatArray:
    """Returns how far the parameters (n, 2) of patches of the plane move within a reach."""
    inverse = np.linalg.inv(patches.axes)
    length = np.linalg.norm(inverse, axis=2)
    return np.asarray((1 + ROUNDING) * np.expand_dims(reach, -1) * length)


@dataclass(frozen=True, eq=False)
class _Moving:
    """How functions over patches differ within a reach of each place."""

    patches: Patches
    reach: float

    def off(self, model: TaylorModel) -> FloatArray:
        """Bounds how far functions are from their means over both sides, (n, f).

        The linear part of a model is its own mean.
        """
        moved = _within(self.patches, self.reach)
        squares = np.stack([moved[:, a] * moved[:, b] for a, b in pairs(2)], axis=1)
        bent = np.einsum("nk,nkf->nf", squares, np.abs(model.quadratic))
        return np.asarray(bent + 2 * model.remainder)

    def change(
        self, model: TaylorModel, n: FloatArray | None = None, rho: float | FloatArray = 1.0
    ) -> FloatArray:
        """Bounds how far means over the way ahead are from those over the way behind, (n, f).

        Args:
            model: The functions.
            n: Half of the way (2, n), in reaches; None: it is of any direction.
            rho: How far half of the way is from n, or, without n, how long it is, in reaches.
        """
        moved = _within(self.patches, self.reach)
        sums = np.stack([moved[:, a] + moved[:, b] for a, b in pairs(2)], axis=1)
        linear = np.einsum(
            "nk,nkf->nf", _within(self.patches, self.reach * rho), np.abs(model.slopes)
        )
        if n is not None:
            steps = np.linalg.solve(self.patches.axes, self.reach * n.T[:, :, None])[:, :, 0]
            straight = np.einsum("nk,nkf->nf", steps, model.slopes)
            linear += np.abs(straight) + ROUNDING * np.einsum(
                "nk,nkf->nf", np.abs(steps), np.abs(model.slopes)
            )
        bent = np.einsum("nk,nkf->nf", sums, np.abs(model.quadratic))
        return np.asarray(linear + bent + 2 * model.remainder)


def _along(
    models: Sequence[TaylorModel], factors: FloatArray | Sequence[FloatArray]
) -> TaylorModel:
    """Returns the sum of vectors (n, 2) times numbers (n,) each."""
    first, *rest = models
    joined = first.joined(*rest)
    sums = []
    for i in (0, 1):
        weights = np.zeros(joined.remainder.shape)
        weights[:, i::2] = np.transpose(factors)
        sums.append(joined.weighted(weights))
    return sums[0].joined(sums[1])


def _range(model: TaylorModel) -> FloatArray:
    return np.maximum(-model.lower, model.upper)


def _length(bounds: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(bounds, axis=1))


def _size(bounds: Sequence[FloatArray]) -> FloatArray:
    """Returns the root of the sum of squares; a mixed derivative stands in it twice."""
    times = [1 if a == b else 2 for a, b in pairs(2)]
    squares = [count * one**2 for count, one in zip(times, bounds, strict=True)]
    return np.asarray(np.sqrt(np.sum(squares, axis=(0, 2))))


def _norms(columns: tuple[TaylorModel, ...]) -> FloatArray:
    """Returns bounds of the spectral norms of matrices of models in the plane."""
    low, high = (
        np.stack([getattr(model, side).T for model in columns]) for side in ("lower", "upper")
    )
    middle, off = (low + high) / 2, (1 + SLACK) * (high - low) / 2
    a, b, c, d = middle.reshape(4, -1)
    # By the parts that turn and reflect.
    norm = np.hypot(a + d, b - c) / 2 + np.hypot(a - d, b + c) / 2
    size = np.abs(middle).sum(axis=(0, 1))
    return np.asarray(norm + np.sqrt((off**2).sum(axis=(0, 1))) + 4 * SLACK * size)


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
