"""Parts of the cells of a tube and of their walls, and their division along the tube."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel

# Parts are halved so often, at most.
HALVINGS = 4
# Parts that are asked about at once.
CHUNK = 200


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

    def models(self) -> tuple[Patches, list[TaylorModel]]:
        """Returns patches that hold all F(t, s), and the models of T, S_1, ... over them.

        The parameters of a patch are t, s_1, ... and the products t s_1, ..., as if these could
        be anything from -1 to 1.
        """
        middle, half = (self.start + self.end) / 2, (self.end - self.start) / 2
        axes = np.concatenate([half[:, :1], middle[:, 1:], half[:, 1:]], axis=1)
        columns = []
        for j in range(middle.shape[1]):
            slopes = np.zeros_like(axes)
            if j:
                slopes[:, 0] = half[:, j]
            else:
                slopes[:, 1 : middle.shape[1]] = half[:, 1:]
            value = middle[:, j] if j else half[:, 0]
            columns.append(TaylorModel.position(Patches(value, np.swapaxes(slopes, 1, 2))))
        return Patches(middle[:, 0], np.swapaxes(axes, 1, 2)), columns


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


def divide(parts: Parts, ask: Callable[[Parts, int], Answer]) -> Division:
    """Halves parts along the tube until a question is decided on each, or as often as may be.

    Args:
        parts: The parts.
        ask: Tells what is known of parts that were halved so often.
    """
    done, facts, left, asked = [], [], [], 0
    for depth in range(HALVINGS + 1):
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
        if not len(parts):
            break
        if depth < HALVINGS:
            parts = parts.halves()
    left.append(parts.cell)
    return Division(join(done), np.concatenate(facts), np.concatenate(left), asked)


def join(parts: list[Parts]) -> Parts:
    """Returns some parts after others."""
    return Parts(
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.end for part in parts]),
        np.concatenate([part.cell for part in parts]),
    )
