"""Which way along each piece: the user's choice, or the rule of the spanning tree."""

from collections.abc import Sequence

import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import TracedPiece, reverse
from sgvf_drake.paths.draft import Direction, direction_choices
from sgvf_drake.paths.polyline import signed_area


def directed(
    points: FloatArray,
    pieces: Sequence[TracedPiece],
    direction: Direction | Sequence[Direction | None] | None,
    start: FloatArray | None = None,
    velocities: FloatArray | None = None,
) -> tuple[TracedPiece, ...]:
    """Returns the pieces in the direction of travel that was asked for.

    Without a choice, closed pieces run counter-clockwise and open ones start at the end
    with the smaller x; see `TracedPiece`.  Velocities come before that rule, a start point
    before velocities, and a direction before both.

    Args:
        points: (M, d).
        pieces: Their pieces, in the direction of the rule.
        direction: For all pieces, or one for each, the longest first.
        start: (d,) open pieces start at the end nearer to it.
        velocities: (M, d) of a robot that travelled the path; zero where unknown.

    Raises:
        ConfigurationError: A direction is unknown, does not fit the pieces in number, or
            asks a piece to turn that is not planar and closed.
    """
    choices = direction_choices(direction, len(pieces))
    return tuple(
        _directed(points, piece, choice, start, velocities)
        for piece, choice in zip(pieces, choices, strict=True)
    )


def _directed(
    points: FloatArray,
    piece: TracedPiece,
    choice: Direction | None,
    start: FloatArray | None,
    velocities: FloatArray | None,
) -> TracedPiece:
    if velocities is not None and _against(points, piece, velocities):
        piece = reverse(piece)
    if start is not None and not piece.closed:
        first, last = points[piece.order[[0, -1]]]
        if np.linalg.norm(last - start) < np.linalg.norm(first - start):
            piece = reverse(piece)
    if choice in ("ccw", "cw"):
        if points.shape[1] != 2 or not piece.closed:
            raise ConfigurationError(
                f"direction {choice!r} is for closed pieces in the plane; "
                "an open piece takes a start point, or 'reverse'"
            )
        turns_left = signed_area(points[piece.order]) > 0
        return piece if turns_left == (choice == "ccw") else reverse(piece)
    if choice == "reverse":
        return reverse(piece)
    return piece


def _against(points: FloatArray, piece: TracedPiece, velocities: FloatArray) -> bool:
    """Whether the velocities run against the piece, chord by chord and on the whole."""
    chords = np.diff(points[piece.order], axis=0)
    mean = (velocities[piece.order[1:]] + velocities[piece.order[:-1]]) / 2
    return float((chords * mean).sum()) < 0
