"""Tubes around orbits, in any dimension: what enters one follows it, cell by cell.

A tube is a chain of sections, each a segment, parallelogram or parallelepiped {p + A s} with
-1 <= s_j <= 1.  The cell between two sections that follow each other is the image of the cube
of all (t, s) under the map

    F(t, s) = (1 - t) / 2 (p + A s) + (1 + t) / 2 (p' + A' s).

Three conditions are proved of a field m over each cell, with T = dF/dt and S_j = dF/ds_j:

- det [T, S_1, ...] > 0 on the whole cell, so that F is one to one near every point of it, and
  m can be written in the coordinates (t, s) there: m = t_dot T + sum_j s_dot_j S_j;
- det [m, S_1, ...] > 0 on the whole cell, which is t_dot > 0 (both in `_ask_time`);
- det [T, ..., m in the place of S_j, ...] is negative all over the wall s_j = 1 and positive
  all over the wall s_j = -1, which is that m points into the cell there, also where walls meet
  (`_ask_wall`).

So an orbit that starts in a section stays within the walls, and passes the next section after
a time between the integrals of the least and the greatest 1 / t_dot over t.  The place where it
does depends continuously on the place where it started.  Neighbouring cells share a section by
what a `Tube` is, and the end of a closed chain is its beginning.  Nothing asks whether cells
overlap, so that knots do not matter.

A closed chain maps its first section continuously into itself, so by Brouwer's theorem an
orbit comes back to where it was: **m has a closed orbit that passes every section**.  Where no
cell but the first and the last touch the first section (`_passes_once`), it passes that once a
lap; otherwise a lap of the chain may be several of the orbit.

It is **the only one**, and attracts whatever enters the tube, if the return map shortens all
curves of the first section in some metric (Banach's theorem).  Let v be the part of a
displacement that is normal to m.  Along an orbit |v| |m|^a changes at the relative rate
(v . J v) / |v|^2 + a (m . J m) / |m|^2.  It is a metric of the section, which m crosses.  With
a = 1 the rate is div m in the plane; with a = 0 it is at most the largest eigenvalue of the
symmetric part of J normal to m (Borg).  So it is enough that the integral of a bound of the
rate over a lap is negative (`_contraction`).

An open chain leads from its first section to its last in bounded time.  Where the last lies in
a `RestBall` that is proved, the orbit stays there and comes to its zero (`_ends_in_rest`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import product
from operator import add
from typing import Any

import numpy as np
from scipy.linalg import null_space

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.contraction import rate_across
from sgvf_drake.certificate.expansions import RECIPROCAL
from sgvf_drake.certificate.field_model import BoundedField, dual_field, has_dual, model_field
from sgvf_drake.certificate.kernels import SLACK, check_rounding
from sgvf_drake.certificate.rest_ball import RestBall, prove_rest
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.certificate.tube_cells import CHUNK, Answer, Division, Parts, divide

TICK = 2.0**-28
"""The unit of the numbers that define a tube, in normalised units.  Sums, differences and
halves of whole numbers of it are exact in float64, so that neighbouring cells meet to the last
bit, and so do the parts that they are divided into."""

LARGEST = 2**32
"""No number is larger, in ticks: all is within sixteen normalised units."""

# A cell is halved until the bounds of the time that it takes are so close, relative to the
# upper one, after each time that it is halved twice as far apart, or so often.
CLOSE, FOR_TIME = 0.01, 4
# Cells on which the rate of contraction may be positive are halved so often.
FOR_RATE = 3
# What is known of the time that a part takes: bounds for all of it, and for a cell as it is.
LOW, HIGH, LEAST, MOST = range(4)
# Beyond the rounding of distances, by far.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Tube:
    """A chain of sections in R^d, and the cells between them.

    Attributes:
        sections: Each of d rows of d whole numbers, in ticks: the middle p and the d - 1
            columns of A, which are half the sides.
        closed: Whether the last section is followed by the first.
        rest: The ball in which an open tube ends; None: it leads to its last section only.

    Raises:
        ValueError: If there are fewer than three sections, or they are not of d rows of d whole
            numbers up to `LARGEST`, or a closed tube has a ball, or it is of another space.
    """

    sections: tuple[tuple[tuple[int, ...], ...], ...]
    closed: bool
    rest: RestBall | None = None

    def __post_init__(self) -> None:
        ticks = np.array(self.sections)
        if ticks.ndim != 3 or len(ticks) < 3 or not 2 <= ticks.shape[1] == ticks.shape[2]:
            raise ValueError("a tube has three sections or more, each of d rows of d numbers")
        if ticks.dtype.kind != "i" or ticks.max() > LARGEST or ticks.min() < -LARGEST:
            raise ValueError(f"sections are of whole numbers up to {LARGEST}")
        if self.rest is not None and (self.closed or len(self.rest.center) != ticks.shape[1]):
            raise ValueError(f"this tube does not end in {self.rest}")

    @classmethod
    def around(
        cls,
        middles: FloatArray,
        axes: FloatArray,
        *,
        closed: bool,
        rest: RestBall | None = None,
    ) -> "Tube":
        """Returns the tube whose sections are the nearest to some numbers.

        Args:
            middles: (K, d) p, normalised.
            axes: (K, d, d - 1) A.
            closed: As the attribute.
            rest: The same.
        """
        rows = np.concatenate([middles[:, None], np.swapaxes(axes, 1, 2)], axis=1)
        ticks = np.rint(rows / TICK).astype(int).tolist()
        return cls(tuple(tuple(map(tuple, section)) for section in ticks), closed, rest)

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Tube":
        """Returns the tube of a JSON object.

        Raises:
            KeyError: If something is missing.
            TypeError: If it is not the object of a tube.
            ValueError: If it is none, by what is said of the class.
        """
        sections = tuple(tuple(map(tuple, section)) for section in body["sections"])
        rest = None if body["rest"] is None else RestBall.of(body["rest"])
        if not isinstance(body["closed"], bool):
            raise TypeError(f"closed must be true or false, not {body['closed']!r}")
        return cls(sections, body["closed"], rest)

    @property
    def rows(self) -> FloatArray:
        """The sections in normalised units, (K, d, d); a closed chain ends with the first."""
        rows = TICK * np.array(self.sections, float)
        return np.concatenate([rows, rows[:1]]) if self.closed else rows

    @property
    def cells(self) -> Parts:
        """The cells between each section and the next."""
        rows = self.rows
        return Parts(rows[:-1], rows[1:], np.arange(len(rows) - 1))

    @property
    def half_width(self) -> float:
        """The largest distance of a corner of a section from its middle."""
        rows = self.rows
        return float(np.linalg.norm(corners(rows) - rows[:, :1], axis=2).max())


def corners(rows: FloatArray) -> FloatArray:
    """Returns the corners of sections (K, d, d), (K, 2^(d-1), d)."""
    signs = np.array(list(product((-1.0, 1.0), repeat=rows.shape[1] - 1)))
    return rows[:, :1] + signs @ rows[:, 1:]


@dataclass(frozen=True, eq=False)
class TubeProof:
    """What is proved of a tube.

    Times are those at |m| = 1 in normalised units of length.

    Attributes:
        proved: Whether what enters the tube follows it for ever, or to its end, and rests
            there if it ends in a ball.
        weak: (K,) the cells of which that was not proved.
        patches: How many patches the field was bounded over.
        time_low: What a lap, or the way from the first section to the last, takes at least.
        time_high: What it takes at most.
        once: Whether a closed orbit passes the first section once a lap.
        contraction: A bound of the logarithm of what a lap makes of lengths across m; None:
            the tube is open, or nothing bounds it.
    """

    proved: bool
    weak: BoolArray
    patches: int
    time_low: float = np.nan
    time_high: float = np.nan
    once: bool = False
    contraction: float | None = None

    @property
    def spread(self) -> float:
        """How far the bounds of the time are from their middle, relative to that."""
        return (self.time_high - self.time_low) / (self.time_high + self.time_low)

    @property
    def unique(self) -> bool:
        """Whether a closed tube is proved to hold one closed orbit, which attracts it all."""
        return self.proved and self.contraction is not None and self.contraction < 0


def prove_tube(field: BoundedField, tube: Tube) -> TubeProof:
    """Proves that what enters a tube follows it, and what that says of a closed orbit.

    Args:
        field: m.
        tube: The tube.

    Raises:
        ConfigurationError: If the field is of a kind that nothing bounds.
        RuntimeError: If the process does not round to nearest.
        ValueError: If the tube is not in the space of the field.
    """
    check_rounding()
    cells, dim = tube.cells, len(tube.sections[0])
    if dim != field.dim:
        raise ValueError(f"a tube in {dim}-D is none of a field in {field.dim}-D")
    # What overflows is not below any bound.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        questions = [
            divide(cells.wall(column, side), partial(_ask_wall, field, side * (-1) ** column))
            for column, side in product(range(1, dim), (1, -1))
        ]
        if not any(len(walls.open_cells) for walls in questions):
            questions.append(divide(cells, partial(_ask_time, field)))
        patches = sum(question.asked for question in questions)
        weak = np.zeros(len(cells), bool)
        for question in questions:
            weak[question.open_cells] = True
        if weak.any() or not _ends_in_rest(field, tube):
            return TubeProof(False, weak, patches)
        return _proved(field, tube, cells, questions[-1], patches)


def _ends_in_rest(field: BoundedField, tube: Tube) -> bool:
    """Whether the last section is in the ball of the tube, and what is there comes to rest."""
    if tube.rest is None:
        return True
    off = np.linalg.norm(corners(tube.rows[-1:])[0] - tube.rest.center, axis=1).max()
    return (
        bool(off <= (1 - ROUNDING) * tube.rest.radius) and prove_rest(field, tube.rest).proved
    )


def _proved(
    field: BoundedField, tube: Tube, cells: Parts, times: Division, patches: int
) -> TubeProof:
    """Returns what follows for a tube whose cells are proved."""
    rounding = SLACK * len(times.facts)
    low, high = times.facts[:, [LOW, HIGH]].sum(axis=0) * [1 - rounding, 1 + rounding]
    proof = TubeProof(True, np.zeros(len(cells), bool), patches, float(low), float(high))
    if not tube.closed:
        return proof
    proof = replace(proof, once=_passes_once(tube.rows))
    if not has_dual(field):
        return proof
    bounds = np.tile([np.inf, 0.0], (len(cells), 1))
    np.minimum.at(bounds[:, LOW], times.parts.cell, times.facts[:, LEAST])
    np.maximum.at(bounds[:, HIGH], times.parts.cell, times.facts[:, MOST])
    contraction, asked = _contraction(field, cells, bounds)
    return replace(proof, contraction=contraction, patches=patches + asked)


def _passes_once(rows: FloatArray) -> bool:
    """Whether no cells but the first and the last touch the first section, and these once.

    A closed orbit then passes that section once a lap.  In coordinates of the section, where it
    is a cube in a plane, each other cell is beyond one of its sides or on one side of the
    plane, as all of its corners are.
    """
    onward = null_space(rows[0, 1:])[:, 0]
    onward *= np.sign(onward @ (rows[1, 0] - rows[0, 0]))
    frame = np.column_stack([onward, *rows[0, 1:]])
    off = ROUNDING / np.linalg.norm(frame, ord=-2)
    y = np.linalg.solve(frame, (corners(rows) - rows[0, 0])[..., None])[..., 0]
    ends = np.concatenate([y[:-1], y[1:]], axis=1)
    low, high = ends.min(axis=1), ends.max(axis=1)
    apart = (low[:, 0] > off) | (high[:, 0] < -off)
    apart |= ((low[:, 1:] > 1 + off) | (high[:, 1:] < -1 - off)).any(axis=1)
    return bool(apart[1:-1].all() and y[1, :, 0].min() > off and y[-2, :, 0].max() < -off)


def _ask_wall(field: BoundedField, sign: int, parts: Parts, _: int) -> Answer:
    """Asks whether m points inward all over parts of walls.

    Args:
        field: m.
        sign: So many times det [m, T, ...] is above zero where m points outward: the side of
            the wall, and a change of sign for each column that m stands before.
        parts: The parts.
    """
    N = normal(parts.columns).scaled(float(sign))
    outward = N.dot(model_field(field, parts.patches))
    lower, upper = outward.lower[:, 0], outward.upper[:, 0]
    return Answer(upper < 0, lower >= 0, np.empty((len(parts), 0)))


def _ask_time(field: BoundedField, parts: Parts, depth: int) -> Answer:
    """Asks how long orbits take through parts of cells, at least and at most.

    That is between the bounds of 2 det [T, S_1, ...] / det [m, S_1, ...].
    """
    along, *columns = parts.columns
    N = normal(columns)
    volume, flux = N.dot(along), N.dot(model_field(field, parts.patches))
    refuted = (volume.upper[:, 0] <= 0) | (flux.upper[:, 0] <= 0)
    onward = (volume.lower[:, 0] > 0) & (flux.lower[:, 0] > 0)
    facts, reducible = np.full((len(parts), 4), np.nan), np.zeros(len(parts))
    if onward.any():
        volume, flux = volume[onward], flux[onward]
        times = volume.scaled(2.0) * flux.apply(RECIPROCAL, least=float(flux.lower.min()))
        bounds = np.concatenate([np.maximum(times.lower, 0), times.upper], axis=1)
        facts[onward] = np.concatenate([bounds, 2**depth * bounds], axis=1)
        # How the time changes across the tube stays, however often a cell is halved.
        across = 2 * np.abs(times.slopes[:, 1 : 1 + len(columns), 0]).sum(axis=1)
        reducible[onward] = bounds[:, HIGH] - bounds[:, LOW] - across
    enough = (reducible <= 2**depth * CLOSE * facts[:, HIGH]) | (depth >= FOR_TIME)
    return Answer(onward & enough & np.isfinite(facts).all(axis=1), refuted, facts)


def normal(columns: Sequence[TaylorModel]) -> TaylorModel:
    """Returns the models of the N with N . x = det [x, columns], for d - 1 columns of R^d."""
    rows = range(len(columns) + 1)
    minors = (_minor(columns, [r for r in rows if r != row]) for row in rows)
    first, *others = (minor.scaled((-1.0) ** row) for row, minor in enumerate(minors))
    return first.joined(*others)


def _minor(columns: Sequence[TaylorModel], rows: list[int]) -> TaylorModel:
    """Returns the models (n, 1) of the determinant of some rows of as many columns."""
    first, *others = columns
    entries = [first.functions(slice(row, row + 1)) for row in rows]
    if not others:
        return entries[0]
    terms = (
        (entry * _minor(others, rows[:k] + rows[k + 1 :])).scaled((-1.0) ** k)
        for k, entry in enumerate(entries)
    )
    return reduce(add, terms)


def _contraction(
    field: BoundedField, parts: Parts, bounds: FloatArray
) -> tuple[float | None, int]:
    """Returns a bound of the integral of the rate of contraction over a lap, if there is one.

    And the number of patches over which the derivatives of the field were bounded.

    Args:
        field: m.
        parts: The cells.
        bounds: (n, 2) of the time that each takes, in proportion to t at every t.
    """
    asked, settled = 0, 0.0
    for depth in range(FOR_RATE + 1):
        chunks = (parts[first : first + CHUNK] for first in range(0, len(parts), CHUNK))
        rate = np.concatenate([rate_across(dual_field(field, chunk.hulls)) for chunk in chunks])
        asked += len(parts)
        integral = rate * np.where(rate > 0, bounds[:, HIGH], bounds[:, LOW])
        total = settled + integral.sum() + SLACK * len(rate) * np.abs(integral).sum()
        loose = ~(integral < 0)
        if total < 0 or depth == FOR_RATE or not loose.any():
            break
        settled += float(integral[~loose].sum() * (1 - SLACK * len(rate)))
        parts, bounds = parts[loose].halves(), np.tile(bounds[loose] / 2, (2, 1))
    return float(total) if np.isfinite(total) else None, asked
