"""What Fig. 1 says, against what was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.metrics import REACH_DISTANCE, SETTLE_DISTANCE

SECTION = "Section I, Fig. 1"
# A curve has the shape of the path where it stays this near to it (U), and is no longer or
# shorter by more than this part of it.
NEAR, LENGTH_TOLERANCE = REACH_DISTANCE, 0.05
# It is broken where it is farther from the path than an agent that follows it (U), and longer
# by more than this factor.
FAR, LONGER = SETTLE_DISTANCE, 1.5
# Fields trained on two orders agree where they differ by at most this factor more than those
# of two seeds, which draw other numbers in the training.
AGREEMENT = 1.5
# Agents that succeed, and waypoints that they pass, where a path is followed; and in part.
MOST, HALF = 0.95, 0.5

LABELS = {"fourier": "Fourier", "lagrange": "Lagrange"}

Row = Mapping[str, Any]
Agents = Mapping[tuple[str, str], Sequence[Row]]
"""Rows of the seeds, by case and field."""


def indexing_claims(
    curves: Sequence[Row],
    agents: Agents,
    learned: str,
    changes: Mapping[str, Sequence[float]],
) -> list[Claim]:
    """Returns the claims.

    Args:
        curves: One a curve: case, curve, waypoints, length_ratio, farthest_u.
        agents: Success and coverage with each seed, by case and field.
        learned: The recipe of the learned fields.
        changes: By how much learned fields differ over the box, root mean square: `order`,
            between two orders of the waypoints, and `seed`, between two seeds.
    """
    return [
        _preserved_claim([row for row in curves if row["case"] == "ordered"]),
        _broken_claim([row for row in curves if row["case"] == "shuffled"], agents),
        _branching_claim([row for row in curves if row["case"] == "branching"], agents),
        _free_claim(learned, agents["shuffled", learned], changes),
        _branches_claim(learned, agents["branching", learned]),
    ]


def label(field: str) -> str:
    """Returns what a field is called: by its curve, or by its recipe."""
    return LABELS.get(field, f"SGVF, {field}")


def is_preserved(row: Row) -> bool:
    """Returns whether a curve has the shape of its path."""
    return row["farthest_u"] <= NEAR and abs(row["length_ratio"] - 1) <= LENGTH_TOLERANCE


def is_broken(row: Row) -> bool:
    """Returns whether a curve has lost the shape of its path."""
    return row["farthest_u"] > FAR and row["length_ratio"] > LONGER


def _preserved_claim(rows: Sequence[Row]) -> Claim:
    return Claim(
        "indexing-ordered",
        SECTION,
        "Orderly indexing preserves the shape of the waypoints.",
        Verdict.of([is_preserved(row) for row in rows]),
        f"{_curves(rows)}.",
    )


def _broken_claim(rows: Sequence[Row], agents: Agents) -> Claim:
    return Claim(
        "indexing-shuffled",
        SECTION,
        "Shuffled waypoints break the interpolation.",
        Verdict.of([is_broken(row) for row in rows]),
        f"{sum(map(is_broken, rows))} of {len(rows)} curves are broken, the least of them "
        f"{min(row['length_ratio'] for row in rows):.1f} times too long; of the agents "
        f"{_success(agents, 'shuffled')} succeed.",
    )


def _branching_claim(rows: Sequence[Row], agents: Agents) -> Claim:
    return Claim(
        "indexing-branching",
        SECTION,
        "Branching waypoints cannot be sequentially indexed: an order arm by arm, the best "
        "there is, breaks the interpolation.",
        Verdict.of([is_broken(row) for row in rows]),
        f"Given arm by arm: {_curves(rows)}; of the agents {_success(agents, 'branching')} "
        "succeed.",
    )


def _free_claim(
    recipe: str, shuffled: Sequence[Row], changes: Mapping[str, Sequence[float]]
) -> Claim:
    order, seed = (sum(changes[key]) / len(changes[key]) for key in ("order", "seed"))
    success = min(row["success"] for row in shuffled)
    good = [order <= AGREEMENT * seed, success >= MOST]
    return Claim(
        "indexing-free",
        SECTION,
        f"SGVF needs no order of the waypoints (recipe {recipe}).",
        Verdict.of(good),
        f"Another order changes m by {order:.3f} (RMS over the box), another seed by "
        f"{seed:.3f}; of the agents on shuffled waypoints at least {success:.0%} succeed.",
        of_paper=recipe == "paper",
    )


def _branches_claim(recipe: str, rows: Sequence[Row]) -> Claim:
    success, coverage = (
        sum(row[key] for row in rows) / len(rows) for key in ("success", "coverage")
    )
    verdict = Verdict.FAILS
    if min(success, coverage) >= MOST:
        verdict = Verdict.HOLDS
    elif min(success, coverage) >= HALF:
        verdict = Verdict.PARTLY
    return Claim(
        "indexing-branches",
        "Abstract, Section I",
        f"SGVF guides along branching waypoints (recipe {recipe}).",
        verdict,
        f"{success:.0%} of the agents follow the branches, and pass {coverage:.0%} of the "
        "waypoints; a field without memory has one direction at the fork.",
        of_paper=recipe == "paper",
    )


def _curves(rows: Sequence[Row]) -> str:
    return "; ".join(
        f"{LABELS[row['curve']]} through {row['waypoints']}: "
        f"{_short(row['length_ratio'])} times the true length, "
        f"up to {_short(row['farthest_u'])} U away"
        for row in rows
    )


def _short(value: float) -> str:
    """Returns a number as one would write it: a curve may be thousands of times too long."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"


def _success(agents: Agents, case: str) -> str:
    shares = [
        f"{sum(row['success'] for row in rows) / len(rows):.0%} ({label(method)})"
        for (own, method), rows in agents.items()
        if own == case
    ]
    return ", ".join(shares)
