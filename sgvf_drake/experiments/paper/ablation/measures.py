"""What both ablations measure of a field: how it is followed, which way it runs, the checks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sgvf_drake.experiments.follow import follow
from sgvf_drake.experiments.paper.ablation.along_path import PieceDirection
from sgvf_drake.experiments.quality.measures import following
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov import verify
from sgvf_drake.metrics import default_duration
from sgvf_drake.paths import ReferencePath

ENDS = "ends"
"""In the file of a run: (n, 2) the last positions of its agents."""

FOLLOWED = "followed"
"""In the same file: (n,) whether each agent completed a lap."""


def followed_row(
    field: GuidingField, reference: ReferencePath, starts: int, patience: float, file: Path
) -> Row:
    """Follows a field in one diagram; leaves where its agents ended.

    Args:
        field: The field.
        reference: The true path, of closed pieces.
        starts: Number of agents, on a grid over the box.
        patience: The usual time to run is multiplied by this.
        file: Where the last positions go, `.npz`.

    Returns:
        What `quality.measures.following` does; `settle`, the fraction of agents that stayed
        near the path over the last lap; `followable`: whether every agent completed a lap,
        and some did on each piece.
    """
    unit = field.cloud.unit_length
    run = follow(field, reference, starts, patience * default_duration(reference, unit))
    metrics = run.metrics
    np.savez(file, **{ENDS: run.positions[-1], FOLLOWED: metrics.lapped})
    lapped_on = [(metrics.piece == piece).any() for piece in range(len(reference.pieces))]
    return {
        **following(run, unit),
        "settle": float(metrics.settled.mean()),
        "followable": bool(metrics.lapped.all() and all(lapped_on)),
    }


def checked_row(field: GuidingField, reference: ReferencePath, ratios: Sequence[float]) -> Row:
    """Passes a field through the sublevel checks; see `lyapunov.verify`.

    Args:
        field: The field.
        reference: The true path.
        ratios: The noise levels of V to try, in those of the field.

    Returns:
        holds, reason; band: whether V falls on a band of levels about a tube along the path;
        zeros: number of zeros of m that count against it; slowest: the smallest |m| in the
        tube, or near the path; falls: part of the box where V falls; cosine: the paper's
        eps, the mean of |cos(s, v)| over the box; length_error: the mean of | |m| - 1 |
        there.
    """
    found = verify(field, reference, ratios=ratios)
    zeros = [v for v in found.violations if v.counts and v.kind == "zero"]
    return {
        "holds": found.holds,
        "reason": found.reason,
        "band": found.band is not None,
        "zeros": len(zeros),
        "slowest": found.slowest,
        "falls": found.decrease_fraction,
        "cosine": found.assumptions.cosine.mean,
        "length_error": found.assumptions.length.mean,
    }


def direction_row(pieces: list[PieceDirection]) -> Row:
    """Sums up which way a field runs along the pieces of a path.

    Returns:
        sources, sinks: their number on a piece, the mean over pieces; conflicted: the share
        of pieces that have any; opposed: the largest share of the length of a piece on which
        the field runs against the rest of it.
    """
    return {
        "sources": float(np.mean([len(piece.sources) for piece in pieces])),
        "sinks": float(np.mean([len(piece.sinks) for piece in pieces])),
        "conflicted": float(np.mean([piece.has_conflict for piece in pieces])),
        "opposed": max(piece.against for piece in pieces),
    }
