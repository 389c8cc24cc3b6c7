"""Branch and bound: squares are divided until a question is decided on each."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes

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
) -> Division:
    """Divides squares until a question is decided on each.

    Args:
        boxes: The squares.
        ask: Tells what is known of squares.
        refute: Tells at which points (n, 2) the answer is no, by the field itself; asked at
            the centres of squares that are undecided.
        smallest: Half-side at which, when all squares are as small, they are divided no more.
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
        if refuted.any() or (len(boxes) and boxes.half.max() <= smallest):
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
