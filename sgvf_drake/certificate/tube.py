"""Tubes around orbits, in any dimension: what enters one follows it, cell by cell.

A tube is a chain of sections, each a segment, parallelogram or parallelepiped {p + A s} with
-1 <= s_j <= 1.  The cell between two sections that follow each other is the image of the cube
of all (t, s) under the map

    F(t, s) = (1 - t) / 2 (p + A s) + (1 + t) / 2 (p' + A' s).

Three conditions are proved of a field m over each cell, with T = dF/dt and S_j = dF/ds_j:

- det [T, S_1, ...] > 0 on the whole cell, so that F is one to one near every point of it, and
  m can be written in the coordinates (t, s) there: m = t_dot T + sum_j s_dot_j S_j;
- det [m, S_1, ...] > 0 on the whole cell, which is t_dot > 0;
- det [T, ..., m in the place of S_j, ...] is negative all over the wall s_j = 1 and positive
  all over the wall s_j = -1, which is that m points into the cell there, also where walls meet.

An orbit that starts in a section thus stays within the walls, and passes the next section
after a time between the integrals of the least and the greatest 1 / t_dot over t.  The point
where it does depends continuously on the point where it started.  Nothing asks whether a cell
overlaps another, so that knots do not matter.

A closed chain maps its first section continuously into itself, so by Brouwer's theorem an
orbit comes back to where it was: **m has a closed orbit that passes every section**.  Where no
cell but the first and the last touch the first section, it passes that once a lap.

It is **the only one**, and attracts whatever enters the tube, if the return map shortens all
curves of the section in some Riemannian metric (Banach's theorem).  With a displacement v
normal to m along an orbit, the metric |m|^a |v| changes at the rate
(v . J v) / |v|^2 + a (m . J m) / |m|^2, which is div m in the plane with a = 1, and at most the
largest eigenvalue of the symmetric part of J normal to m with a = 0 (Borg).  So it is enough
that the integral of a bound of this rate over a lap is negative.

An open chain leads from its first section to its last in bounded time.  Where the last lies in
a `Rest`, the orbit stays there and comes to its zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import product
from operator import add
from typing import Any

import numpy as np
from scipy.linalg import null_space

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.expansions import RECIPROCAL
from sgvf_drake.certificate.field_model import BoundedField, dual_field, has_dual, model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.certificate.tube_cells import CHUNK, Answer, Division, Parts, divide

TICK = 2.0**-28
"""The unit of the numbers that define a tube, in normalised units.  Sums, differences and
halves of whole numbers of it are exact in float64, so that neighbouring cells meet to the last
bit, and so do the parts that they are divided into."""

LARGEST = 2**31
"""No number is larger, in ticks: all is within eight normalised units."""

# A cell is halved until the bounds of the time that it takes are so close, relative to the
# upper one, or so often.
CLOSE, FOR_TIME = 0.01, 2
# Parts on which the rate of contraction may be positive are halved so often.
FOR_RATE = 3
# How firmly m is kept out of the eigenvectors of a symmetric part: c |m|^2 over its size.
FIRMNESS = 2.0
# Columns of what is known of the time that a part takes.
LOW, HIGH = range(2)
# Beyond the rounding of coordinates in the frame of a section, and of eigenvalues, by far.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Tube:
    """A chain of sections in R^d, and the cells between them.

    Attributes:
        sections: Each of d rows of d whole numbers, in ticks: the middle p and the d - 1
            columns of A, which are half the sides.
        closed: Whether the last section is followed by the first.
    """

    sections: tuple[tuple[tuple[int, ...], ...], ...]
    closed: bool

    @classmethod
    def around(cls, middles: FloatArray, axes: FloatArray, *, closed: bool) -> "Tube":
        """Returns the tube whose sections are the nearest to some numbers.

        Args:
            middles: (K, d) p, normalised.
            axes: (K, d, d - 1) A.
            closed: Whether the last section is followed by the first.
        """
        rows = np.concatenate([middles[:, None], np.swapaxes(axes, 1, 2)], axis=1)
        ticks = np.rint(rows / TICK).astype(int).tolist()
        return cls(tuple(tuple(map(tuple, section)) for section in ticks), closed)

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Tube":
        """Returns the tube of a JSON object.

        Raises:
            KeyError: If something is missing.
            TypeError: If it is not the object of a tube.
            ValueError: If the sections are not those of a tube.
        """
        sections = tuple(
            tuple(tuple(map(_ticks, row)) for row in section) for section in body["sections"]
        )
        if not isinstance(body["closed"], bool):
            raise TypeError(f"closed must be true or false, not {body['closed']!r}")
        if len(sections) < 3:
            raise ValueError(f"a tube has three sections or more, not {len(sections)}")
        dim = len(sections[0])
        if dim < 2 or any(len(row) != dim for section in sections for row in (section, *section)):
            raise ValueError("each section must have d rows of d numbers")
        return cls(sections, body["closed"])

    @property
    def rows(self) -> FloatArray:
        """The sections in normalised units, (K, d, d); a closed chain ends with the first."""
        rows = TICK * np.array(self.sections, float)
        return np.concatenate([rows, rows[:1]]) if self.closed else rows

    @property
    def half_width(self) -> float:
        """The largest distance of a corner of a section from its middle."""
        rows = self.rows
        return float(np.linalg.norm(_corners(rows) - rows[:, :1], axis=2).max())

    @property
    def passes_once(self) -> bool:
        """Whether no cell but the first and the last touch the first section.

        A closed orbit of a closed chain then passes that section once.  In the coordinates of
        the section, in which it is the cube, each other cell is beyond one of its sides or on
        one side of its plane, as its corners are.
        """
        rows = self.rows
        onward = null_space(rows[0, 1:])[:, 0]
        onward *= np.sign(onward @ (rows[1, 0] - rows[0, 0]))
        frame = np.column_stack([onward, *rows[0, 1:]])
        y = np.linalg.solve(frame, (_corners(rows) - rows[0, 0])[..., None])[..., 0]
        cells = np.concatenate([y[:-1], y[1:]], axis=1)
        low, high = cells.min(axis=1), cells.max(axis=1)
        apart = (low[:, 0] > ROUNDING) | (high[:, 0] < -ROUNDING)
        apart |= ((low[:, 1:] > 1 + ROUNDING) | (high[:, 1:] < -1 - ROUNDING)).any(axis=1)
        leaves, comes = y[1, :, 0].min() > ROUNDING, y[-2, :, 0].max() < -ROUNDING
        return bool(apart[1:-1].all() and leaves and comes)


def _ticks(number: Any) -> int:
    if type(number) is not int:
        raise TypeError(f"a section is of whole numbers, not {number!r}")
    if abs(number) > LARGEST:
        raise ValueError(f"{number} ticks are outside of what is bounded")
    return number


def _corners(rows: FloatArray) -> FloatArray:
    """Returns the corners of sections (K, d, d), (K, 2^(d-1), d)."""
    signs = np.array(list(product((-1.0, 1.0), repeat=rows.shape[1] - 1)))
    return rows[:, :1] + signs @ rows[:, 1:]


@dataclass(frozen=True, eq=False)
class TubeProof:
    """What is proved of a tube.

    Times are those at |m| = 1 in normalised units of length.

    Attributes:
        proved: Whether what enters the tube follows it to its end, or for ever.
        weak: (K,) the cells of which that was not proved.
        time_low: Time from the first section to the last, or of a lap, at least.
        time_high: The same, at most.
        contraction: A bound of the logarithm of what a lap makes of lengths across m; None:
            the chain is open, or nothing bounds the derivatives of the field.
        patches: Over how many patches the field was bounded.
    """

    proved: bool
    weak: BoolArray
    time_low: float
    time_high: float
    contraction: float | None
    patches: int

    @property
    def unique(self) -> bool:
        """Whether a closed tube is proved to hold one closed orbit, which attracts it all."""
        return self.proved and self.contraction is not None and self.contraction < 0


def prove_tube(field: BoundedField, tube: Tube) -> TubeProof:
    """Proves that what enters a tube follows it.

    Args:
        field: m.
        tube: The tube.
    """
    rows = tube.rows
    cells = Parts(rows[:-1], rows[1:], np.arange(len(rows) - 1))
    times = divide(cells, partial(_ask_time, field))
    walls = [
        divide(cells.wall(column, side), partial(_ask_wall, field, side * (-1) ** column))
        for column, side in product(range(1, field.dim), (1, -1))
    ]
    weak = np.zeros(len(cells), bool)
    for question in (times, *walls):
        weak[question.open_cells] = True
    patches = sum(question.asked for question in (times, *walls))
    if weak.any():
        return TubeProof(False, weak, np.nan, np.nan, None, patches)
    contraction = None
    if tube.closed and has_dual(field):
        spent = np.stack([np.bincount(times.parts.cell, column) for column in times.facts.T], 1)
        contraction, asked = _contraction(field, cells, spent)
        patches += asked
    rounding = SLACK * len(times.facts)
    low, high = times.facts.sum(axis=0) * [1 - rounding, 1 + rounding]
    return TubeProof(True, weak, float(low), float(high), contraction, patches)


def _ask_wall(field: BoundedField, sign: int, parts: Parts, _: int) -> Answer:
    """Asks whether m points inward all over parts of walls.

    Args:
        field: m.
        sign: So many times det [m, T, ...] is above zero where m points outward: the side of
            the wall, and a change of sign for each column that m stands before.
        parts: The parts.
    """
    patches, columns = parts.models()
    outward = normal(columns).scaled(float(sign)).dot(model_field(field, patches))
    lower, upper = outward.lower[:, 0], outward.upper[:, 0]
    return Answer(upper < 0, lower >= 0, np.empty((len(parts), 0)))


def _ask_time(field: BoundedField, parts: Parts, depth: int) -> Answer:
    """Asks how long orbits take through parts of cells, at least and at most.

    That is between the bounds of 2 det [T, S_1, ...] / det [m, S_1, ...].
    """
    patches, (along, *columns) = parts.models()
    N = normal(columns)
    volume, flux = N.dot(along), N.dot(model_field(field, patches))
    refuted = (volume.upper[:, 0] <= 0) | (flux.upper[:, 0] <= 0)
    onward = (volume.lower[:, 0] > 0) & (flux.lower[:, 0] > 0)
    facts = np.full((len(parts), 2), np.nan)
    if onward.any():
        volume, flux = volume[onward], flux[onward]
        times = volume.scaled(2.0) * flux.apply(RECIPROCAL, least=float(flux.lower.min()))
        facts[onward] = np.concatenate([np.maximum(times.lower, 0), times.upper], axis=1)
    low, high = facts.T
    decided = onward & ((high - low <= CLOSE * high) | (depth >= FOR_TIME))
    return Answer(decided, refuted, facts)


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


def _contraction(field: BoundedField, parts: Parts, facts: FloatArray) -> tuple[float, int]:
    """Returns a bound of the integral of the rate of contraction over a lap.

    And the number of patches over which the derivatives of the field were bounded.

    Args:
        field: m.
        parts: The cells.
        facts: (n, 2) bounds of the time that an orbit takes through each.
    """
    asked, settled = 0, 0.0
    for depth in range(FOR_RATE + 1):
        asked += len(parts)
        rate = np.concatenate(
            [
                _rate(dual_field(field, parts[first : first + CHUNK].models()[0]))
                for first in range(0, len(parts), CHUNK)
            ]
        )
        # Half of a part takes half of what the bounds say of it.
        integral = rate * np.where(rate > 0, facts[:, HIGH], facts[:, LOW])
        total = settled + integral.sum() + SLACK * len(rate) * np.abs(integral).sum()
        loose = ~(integral < 0)
        if total < 0 or depth == FOR_RATE or not loose.any():
            break
        settled += float(integral[~loose].sum())
        parts, facts = parts[loose].halves(), np.tile(facts[loose] / 2, (2, 1))
    return float(total), asked


def _rate(dual: DualModel) -> FloatArray:
    """Returns bounds from above of the rate at which lengths across m change, (n,)."""
    if len(dual.slopes) == 2:
        return np.asarray(dual.divergence.upper[:, 0])
    # With v normal to m, v . J v = v . (S - c m m^T) v for the symmetric part S and any c.
    J, J_off = _middles(dual.slopes)
    m, m_off = (parts[..., 0] for parts in _middles((dual.value,)))
    S, S_off = (J + J.swapaxes(1, 2)) / 2, (J_off + J_off.swapaxes(1, 2)) / 2
    size, m_size = np.linalg.norm(S, axis=(1, 2)), np.linalg.norm(m, axis=1)
    c = FIRMNESS * size / m_size**2
    off = np.linalg.norm(m_off, axis=1)
    across = S - c[:, None, None] * m[:, :, None] * m[:, None, :]
    rounding = ROUNDING * np.linalg.norm(across, axis=(1, 2))
    varied = np.linalg.norm(S_off, axis=(1, 2)) + c * off * (2 * m_size + off)
    return np.linalg.eigvalsh(across)[:, -1] + (1 + ROUNDING) * varied + rounding


def _middles(models: Sequence[TaylorModel]) -> tuple[FloatArray, FloatArray]:
    """Returns numbers, (n, f, len(models)), and how far the functions go from them at most."""
    low, high = (
        np.stack([getattr(model, side) for model in models], axis=2)
        for side in ("lower", "upper")
    )
    middle = (low + high) / 2
    return middle, (1 + SLACK) * np.maximum(high - middle, middle - low)
