"""What Fig. 2 says, against what was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

from sgvf_drake.paper.intervals import fraction_interval
from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.overview.losses import LossCourse

SECTION = "Section V-A, Fig. 2"
# The score shows the density of the waypoints where it points the way of the exact one: to
# 25 degrees on average, and to the same side in 95 of 100 places near the path.
MEAN_COSINE, LOW_COSINE = 0.9, 0.0

Row = Mapping[str, Any]


def overview_claims(
    rows: Mapping[str, Sequence[Row]], totals: Mapping[str, Sequence[LossCourse]]
) -> list[Claim]:
    """Returns three claims for each recipe.

    Args:
        rows: What was measured of the fields of each recipe.
        totals: The course of the total tangent loss of each.
    """
    return [
        claim
        for recipe, own in rows.items()
        for claim in (
            _score_claim(recipe, own),
            _losses_claim(recipe, totals[recipe]),
            _tracking_claim(recipe, own),
        )
    ]


def followed(row: Row) -> bool:
    """Returns whether all starts lap, on all pieces."""
    return bool(row["all_lap"]) and row["pieces_lapped"] == row["pieces"]


def _score_claim(recipe: str, rows: Sequence[Row]) -> Claim:
    means = [row["score_cosine"] for row in rows]
    lows = [row["score_cosine_p5"] for row in rows]
    good = [
        mean >= MEAN_COSINE and low >= LOW_COSINE for mean, low in zip(means, lows, strict=True)
    ]
    return Claim(
        f"overview-score-{recipe}",
        SECTION,
        f"The learned score shows the density of the waypoints (recipe {recipe}).",
        Verdict.of(good),
        f"Near the path, its mean cosine with the exact score is {min(means):.2f} to "
        f"{max(means):.2f} over {len(rows)} fields, the 5th percentile {min(lows):.2f} to "
        f"{max(lows):.2f}.",
        of_paper=recipe == "paper",
    )


def _losses_claim(recipe: str, totals: Sequence[LossCourse]) -> Claim:
    converged = [total.converged for total in totals]
    return Claim(
        f"overview-losses-{recipe}",
        SECTION,
        f"The tangent losses converge and are stable (recipe {recipe}).",
        Verdict.of(converged),
        f"In {sum(converged)} of {len(totals)} trainings the total fell and came to rest: "
        f"from {_span([total.begin for total in totals])} in the first tenth to "
        f"{_span([total.end for total in totals])} in the last, which differs from the one "
        f"before by at most {max(abs(total.change) for total in totals):.0%}. (The learning "
        "rate of the robust recipe falls to zero.)",
        of_paper=recipe == "paper",
    )


def _tracking_claim(recipe: str, rows: Sequence[Row]) -> Claim:
    good = [followed(row) for row in rows]
    share, low, high = fraction_interval(sum(good), len(good))
    laps = [row["lap"] for row in rows]
    return Claim(
        f"overview-tracking-{recipe}",
        SECTION,
        f"Agents track both loops, also disjoint ones (recipe {recipe}); measured by more than "
        "the two agents of the paper: all starts of a grid.",
        Verdict.of(good),
        f"All starts lap, on both pieces, in {sum(good)} of {len(good)} trained fields "
        f"({share:.0%}, 95 % interval {low:.0%} to {high:.0%}); in the worst field "
        f"{min(laps):.0%} of the starts lap.",
        of_paper=recipe == "paper",
    )


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.2g}-{max(values):.2g}"
