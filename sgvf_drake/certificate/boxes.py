"""Cubes of a dyadic grid, in which sizes, and branch and bound over them."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.fields import GuidingField


@dataclass(frozen=True, eq=False)
class Boxes:
    """n closed squares, or cubes, {c + d : |d_k| <= half} in R^d.

    Centres and half-sides of a dyadic grid are exact in float64, so that neighbours share
    their sides to the last bit, and parts cover their square.

    Attributes:
        centers: c, (n, d).
        half: (n,) half-sides.
    """

    centers: FloatArray
    half: FloatArray

    def __len__(self) -> int:
        return len(self.half)

    def __getitem__(self, rows: BoolArray | slice) -> "Boxes":
        return Boxes(self.centers[rows], self.half[rows])

    @property
    def patches(self) -> Patches:
        """The same, as patches whose parameters go along the coordinates."""
        return Patches(self.centers, self.half[:, None, None] * np.eye(self.centers.shape[1]))

    def quarters(self) -> "Boxes":
        """Returns the quarters of each square, (4 n); of cubes the 2^d parts."""
        half, dim = self.half / 2, self.centers.shape[1]
        steps = np.array(list(product((-1.0, 1.0), repeat=dim)))
        centers = self.centers[:, None] + half[:, None, None] * steps
        return Boxes(centers.reshape(-1, dim), np.repeat(half, len(steps)))

    @classmethod
    def square(cls, half: float) -> "Boxes":
        """Returns the one square around the origin of a half-side."""
        return cls(np.zeros((1, 2)), np.array([half]))

    @classmethod
    def points(cls, points: FloatArray) -> "Boxes":
        """Returns the squares without an extent that points (n, d) are."""
        return cls(points, np.zeros(len(points)))


HALF_WIDTH = 8.0
"""Everything is proved inside of a square of this half-side, normalised units; the waypoints
are within 4."""


@dataclass(frozen=True)
class BoxSizes:
    """Half-sides of squares, powers of two.

    Attributes:
        unit: The largest one that is no larger than the noise level of the field.
    """

    unit: float

    @classmethod
    def of(cls, field: GuidingField) -> "BoxSizes":
        """Returns the sizes for a field."""
        return cls(float(2.0 ** np.floor(np.log2(min(field.sigma, 1.0)))))

    @property
    def everything(self) -> Boxes:
        """The square that holds everything."""
        return Boxes.square(HALF_WIDTH)

    @property
    def first(self) -> float:
        """Of those over which a field is bounded first."""
        return self.unit / 2

    @property
    def ring(self) -> float:
        """Of those in the tube."""
        return self.unit / 4

    @property
    def cover(self) -> float:
        """Of the covers whose components and holes are counted."""
        return self.unit / 8

    @property
    def last(self) -> float:
        """Of those that are divided no more."""
        return self.unit / 1024


CHUNK = 1000
"""Squares that are asked about at once."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What was found out over n squares.

    Attributes:
        decided: (n,) whether a square needs no division.
        facts: (n, k) what is known of each.
        evaluated: Number of the squares over which the field was bounded.
    """

    decided: BoolArray
    facts: FloatArray
    evaluated: int


@dataclass(frozen=True, eq=False)
class Division:
    """What a question came to.

    Attributes:
        boxes: The squares on which it is decided.
        facts: (n, k) what is known of each.
        evaluated: Number of squares over which the field was bounded.
        counterexample: (2,) a point at which the answer is no; None: none was found.
        undecided: Squares that would have to be divided further.
    """

    boxes: Boxes
    facts: FloatArray
    evaluated: int
    counterexample: FloatArray | None
    undecided: Boxes

    @property
    def proved(self) -> bool:
        """Whether it is decided everywhere."""
        return self.counterexample is None and len(self.undecided) == 0


def divide(
    boxes: Boxes,
    ask: Callable[[Boxes], Answer],
    refute: Callable[[FloatArray], BoolArray],
    smallest: float,
    most: float = np.inf,
) -> Division:
    """Divides squares until a question is decided on each.

    Args:
        boxes: The squares.
        ask: Tells what is known of squares.
        refute: Tells at which points (n, 2) the answer is no, by the field itself; asked at
            the centres of squares that are undecided.
        smallest: Half-side at which, when all squares are as small, they are divided no more.
        most: Nor where more squares than this would have been asked about.
    """
    decided: list[Boxes] = []
    facts: list[FloatArray] = []
    evaluated = 0
    while len(boxes):
        answers = [ask(boxes[start : start + CHUNK]) for start in range(0, len(boxes), CHUNK)]
        evaluated += sum(answer.evaluated for answer in answers)
        done = np.concatenate([answer.decided for answer in answers])
        decided.append(boxes[done])
        facts.append(np.concatenate([answer.facts for answer in answers])[done])
        boxes = boxes[~done]
        refuted = refute(boxes.centers)
        parts = len(boxes) * 2 ** boxes.centers.shape[1]
        last = boxes.half.max(initial=0.0) <= smallest or evaluated + parts > most
        if refuted.any() or (len(boxes) and last):
            found = boxes.centers[refuted][0] if refuted.any() else None
            return _division(decided, facts, evaluated, found, boxes)
        boxes = boxes.quarters()
    return _division(decided, facts, evaluated, None, boxes)


def _division(
    decided: list[Boxes],
    facts: list[FloatArray],
    evaluated: int,
    counterexample: FloatArray | None,
    undecided: Boxes,
) -> Division:
    boxes = Boxes(
        np.concatenate([part.centers for part in decided]),
        np.concatenate([part.half for part in decided]),
    )
    return Division(boxes, np.concatenate(facts), evaluated, counterexample, undecided)
