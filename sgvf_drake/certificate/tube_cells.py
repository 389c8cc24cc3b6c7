"""Parts of the cells of a tube and of their walls, and their division along the tube."""

from collections.abc import Callable
from dataclasses import dataclass
import sys

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel

# Parts are halved so often, at most.
HALVINGS = 4
# Parts that are asked about at once.
CHUNK = 1000
# The condition number of the directions of axes from which on a cell counts as skewed, and what
# is beyond the rounding of a linear system with a smaller one, by far.
SKEWED, ROUNDING = 100.0, 1e-9


@dataclass(frozen=True, eq=False)
class Parts:
    """n parts of cells, or of walls, each between two sections of its own.

    Attributes:
        start: (n, 1 + r, d) p and the r columns of A where t = -1.
        end: The same where t = 1.
        cell: (n,) of which cell they are.
    """

    start: FloatArray
    end: FloatArray
    cell: IntArray

    def __len__(self) -> int:
        return len(self.cell)

    def __getitem__(self, rows: BoolArray | slice) -> "Parts":
        return Parts(self.start[rows], self.end[rows], self.cell[rows])

    def halves(self) -> "Parts":
        """Returns the first halves and then the second ones, (2 n); see `TICK`."""
        middle = (self.start + self.end) / 2
        start, end = np.concatenate([self.start, middle]), np.concatenate([middle, self.end])
        return Parts(start, end, np.tile(self.cell, 2))

    def longer_halves(self) -> "Parts":
        """Returns halves of cells in the plane, across where that is the longer way."""
        middle, half = self._middle_and_half
        wide = np.linalg.norm(middle[:, 1], axis=1) > np.linalg.norm(half[:, 0], axis=1)
        across = self[wide]
        sides = [
            Parts(_narrowed(across.start, side), _narrowed(across.end, side), across.cell)
            for side in (-0.5, 0.5)
        ]
        return join([self[~wide].halves(), *sides])

    def wall(self, column: int, side: int) -> "Parts":
        """Returns the parts where one s_j is 1 or -1: a column of A goes to the middle."""
        start, end = (
            np.concatenate(
                [
                    rows[:, :1] + side * rows[:, column : column + 1],
                    np.delete(rows, (0, column), axis=1),
                ],
                axis=1,
            )
            for rows in (self.start, self.end)
        )
        return Parts(start, end, self.cell)

    @property
    def patches(self) -> Patches:
        """Patches that hold all F(t, s).

        Their parameters are t, s_1, ... and the products t s_1, ..., as if these could be
        anything from -1 to 1.
        """
        middle, half = self._middle_and_half
        axes = np.concatenate([half[:, :1], middle[:, 1:], half[:, 1:]], axis=1)
        return Patches(middle[:, 0], np.swapaxes(axes, 1, 2))

    @property
    def columns(self) -> list[TaylorModel]:
        """The models of T, S_1, ... over the patches."""
        middle, half = self._middle_and_half
        n, rows, dim = middle.shape
        slopes = np.zeros((rows, n, dim, 2 * rows - 1))
        slopes[0, :, :, 1:rows] = np.swapaxes(half[:, 1:], 1, 2)
        slopes[1:, :, :, 0] = np.swapaxes(half[:, 1:], 0, 1)
        values = [half[:, 0], *np.swapaxes(middle[:, 1:], 0, 1)]
        return [
            TaylorModel.position(Patches(value, slope))
            for value, slope in zip(values, slopes, strict=True)
        ]

    @property
    def hulls(self) -> Patches:
        """Patches of d parameters alone that hold all F(t, s) of cells, and a little more.

        What the products t s_j can do is added to the axes.  A cell whose axes are far from a
        right angle has infinite ones.
        """
        patches, dim = self.patches, self.start.shape[2]
        axes, products = patches.axes[:, :, :dim], patches.axes[:, :, dim:]
        length = np.linalg.norm(axes, axis=1)
        directions = axes / length[:, None]
        upright = np.linalg.cond(directions) < SKEWED
        directions = np.where(upright[:, None, None], directions, np.eye(dim))
        added = np.abs(np.linalg.solve(directions, products)).sum(axis=2)
        added += ROUNDING * (length + np.linalg.norm(products, axis=(1, 2))[:, None])
        grown = axes * (1 + added / length)[:, None]
        return Patches(patches.centers, np.where(upright[:, None, None], grown, np.inf))

    @property
    def _middle_and_half(self) -> tuple[FloatArray, FloatArray]:
        return (self.start + self.end) / 2, (self.end - self.start) / 2


def _narrowed(rows: FloatArray, share: float) -> FloatArray:
    """Returns sections in the plane half as long, moved by a share of what they were."""
    return np.stack([rows[:, 0] + share * rows[:, 1], rows[:, 1] / 2], axis=1)


@dataclass(frozen=True, eq=False)
class Answer:
    """What was found out over n parts.

    Attributes:
        decided: (n,) where a part needs no division.
        refuted: (n,) where the answer is no, so that division is of no use.
        facts: (n, f) what is known of each.
    """

    decided: BoolArray
    refuted: BoolArray
    facts: FloatArray


@dataclass(frozen=True, eq=False)
class Division:
    """What a question came to.

    Attributes:
        parts: The parts on which it is decided.
        facts: (n, f) what is known of each.
        open_cells: The cells of parts on which it is not decided, or the answer is no.
        asked: Over how many parts the field was bounded.
    """

    parts: Parts
    facts: FloatArray
    open_cells: IntArray
    asked: int


def divide(
    parts: Parts,
    ask: Callable[[Parts, int], Answer],
    halves: Callable[[Parts], Parts] = Parts.halves,
    *,
    halvings: int = HALVINGS,
    at_most: int = sys.maxsize,
) -> Division:
    """Halves parts until a question is decided on each, or as often as may be.

    Args:
        parts: The parts.
        ask: Tells what is known of parts that were halved so often.
        halves: Halves parts; along the tube, if nothing else is told.
        halvings: How often, at most.
        at_most: Of how many parts at once it is asked; where there would be more, it is left.
    """
    done, facts, left, asked = [], [], [], 0
    for depth in range(halvings + 1):
        again = []
        for first in range(0, len(parts), CHUNK):
            chunk = parts[first : first + CHUNK]
            answer = ask(chunk, depth)
            asked += len(chunk)
            done.append(chunk[answer.decided])
            facts.append(answer.facts[answer.decided])
            left.append(chunk.cell[answer.refuted])
            again.append(chunk[~answer.decided & ~answer.refuted])
        parts = join(again)
        if not len(parts) or len(parts) > at_most // 2:
            break
        if depth < halvings:
            parts = halves(parts)
    left.append(parts.cell)
    return Division(join(done), np.concatenate(facts), np.concatenate(left), asked)


def join(parts: list[Parts]) -> Parts:
    """Returns some parts after others."""
    return Parts(
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.end for part in parts]),
        np.concatenate([part.cell for part in parts]),
    )
