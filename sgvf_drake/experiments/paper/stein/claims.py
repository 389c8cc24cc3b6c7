"""What Stein's identity was measured to say of the paper's Section II-B and Eq. (2)."""

from collections.abc import Sequence

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.stein.findings import (
    RECIPE_NAMES,
    RESCALED_NAME,
    SQUASHED_NAME,
    Finding,
)
from sgvf_drake.experiments.paper.stein.statistics import z_limit
from sgvf_drake.experiments.paper.stein.trials import EXACT

SECTION = "Section II-B"
# With the number of draws a residual falls by the power -1/2; the fitted power is known to
# a few hundredths.
SLOPE, SLOPE_TOLERANCE = -0.5, 0.05
# A learned score keeps the identity in part where its residual is at most this part of what
# the identity says.
PART = 0.2


def stein_claims(findings: Sequence[Finding]) -> list[Claim]:
    """Returns the claims; each is judged on all densities of the findings."""
    by_score: dict[str, list[Finding]] = {}
    for finding in findings:
        by_score.setdefault(finding.score, []).append(finding)
    return [
        _identity_claim(by_score[EXACT]),
        _log_density_claim(by_score[EXACT]),
        *(
            _learned_claim(recipe, by_score[name][0])
            for recipe, name in RECIPE_NAMES.items()
            if name in by_score
        ),
        _squashed_claim(by_score[SQUASHED_NAME], by_score[RESCALED_NAME]),
        _squashed_mean_claim(by_score[SQUASHED_NAME]),
    ]


def _identity_claim(exact: Sequence[Finding]) -> Claim:
    z, limit = max(finding.z for finding in exact), _limit(exact)
    slopes = [finding.slope for finding in exact]
    holds = z <= limit and all(abs(slope - SLOPE) <= SLOPE_TOLERANCE for slope in slopes)
    return Claim(
        "stein-identity",
        SECTION,
        "E[S f^T] = -E[grad f] for smooth f of compact support.",
        Verdict.HOLDS if holds else Verdict.FAILS,
        f"For the exact score no entry of {sum(f.entries for f in exact)} departs by more "
        f"than {z:.1f} standard errors ({limit:.1f} are exceeded by chance in 1 %), and the "
        f"residual falls with the number of draws to the power "
        f"{min(slopes):.2f} to {max(slopes):.2f}.",
    )


def _log_density_claim(exact: Sequence[Finding]) -> Claim:
    z = max(max(finding.log_z, finding.mean_z) for finding in exact)
    # Two coordinates each of E[S log p] and E[S].
    limit = z_limit(sum(4 * len(finding.logs) for finding in exact))
    largest = max(float(finding.logs.max()) for finding in exact)
    return Claim(
        "stein-log-density",
        SECTION,
        "E[S log p] = 0, and E[S] = 0.",
        Verdict.HOLDS if z <= limit else Verdict.FAILS,
        f"For the exact score they are at most {z:.1f} standard errors from zero (limit "
        f"{limit:.1f}), E[S log p] at most {largest:.2%} of what it could be; it says the "
        "same as E[S] = 0, and log p has no compact support but needs none.",
    )


def _learned_claim(recipe: str, learned: Finding) -> Claim:
    verdict = Verdict.FAILS
    if learned.z <= _limit([learned]):
        verdict = Verdict.HOLDS
    elif learned.share <= PART:
        verdict = Verdict.PARTLY
    return Claim(
        f"stein-learned-{recipe}",
        SECTION,
        f"The learned score satisfies Stein's identity (recipe {recipe}).",
        verdict,
        f"The residual is {learned.share:.0%} of what the identity says (up to "
        f"{learned.z:.0f} standard errors), E[S] is {learned.means.mean():.1%} of its size, "
        f"and the error of the score {learned.score_errors.mean():.0%} of it (RMS).",
        of_paper=recipe == "paper",
    )


def _squashed_claim(squashed: Sequence[Finding], rescaled: Sequence[Finding]) -> Claim:
    z, limit = min(finding.z for finding in squashed), _limit(squashed)
    return Claim(
        "stein-squashed-identity",
        "Section III-B, Eq. (2)",
        "The normalised score s = tanh(k_s |S|) S / |S| does not satisfy the identity.",
        Verdict.HOLDS if z > limit else Verdict.FAILS,
        f"It is off by {squashed[0].share:.0%} of what the identity says, and after "
        f"the best factor, times {rescaled[0].scale:.1f}, the largest entry is off by "
        + " and ".join(
            f"{found.z:.1f} standard errors ({found.share:.1%}) on {found.density}"
            for found in rescaled
        )
        + f" (limit {_limit(rescaled):.1f}).",
    )


def _squashed_mean_claim(squashed: Sequence[Finding]) -> Claim:
    limit = z_limit(sum(2 * len(finding.means) for finding in squashed))
    strongest = max(squashed, key=lambda finding: finding.mean_z)
    return Claim(
        "stein-squashed-mean",
        "Section III-B, Eq. (2)",
        "The normalised score does not have mean zero.",
        Verdict.HOLDS if strongest.mean_z > limit else Verdict.FAILS,
        f"On {strongest.density}, its mean is {strongest.mean_z:.1f} standard errors from "
        f"zero (limit {limit:.1f}), and {strongest.means.mean():.2%} of its size.",
    )


def _limit(findings: Sequence[Finding]) -> float:
    return z_limit(sum(finding.entries for finding in findings))
