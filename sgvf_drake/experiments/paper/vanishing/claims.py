"""What Section VI-A says of score vanishing, against what was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import binomtest

from sgvf_drake.experiments.outcome import Claim, Verdict

SECTION = "Section VI-A, Fig. 5"
# A search of the least |chi| ends this near to it.
SEARCH = 1e-6
# A comparison within one field holds by chance this often.
ERROR = 0.05

Row = Mapping[str, Any]
Cases = Mapping[tuple[str, str], Sequence[Row]]


def vanishing_claims(rows: Cases, pieces: Mapping[str, Sequence[Row]]) -> list[Claim]:
    """Returns the claims.

    Args:
        rows: What was measured of the fields of each shape and recipe.
        pieces: The search for the least |chi| around each piece of each shape.
    """
    everything = [row for own in rows.values() for row in own]
    robust = [row for (_, recipe), own in rows.items() for row in own if recipe == "robust"]
    return [
        _index_claim(everything),
        _singularity_claim(robust),
        _density_claim(everything),
        _curvature_claim(everything),
        _topology_claim(everything),
        _parametric_claim([piece for own in pieces.values() for piece in own]),
    ]


def _index_claim(rows: Sequence[Row]) -> Claim:
    sums = [
        row["score_index_sum"] == row["score_winding_number"]
        and not row["undecided_by_field"]["score"]
        for row in rows
    ]
    regions = [region for row in rows for region in row["regions"]]
    as_euler = [region["index_sum"] == region["euler"] for region in regions]
    verdict = Verdict.FAILS
    if all(sums):
        verdict = Verdict.HOLDS if all(as_euler) else Verdict.PARTLY
    return Claim(
        "vanishing-indices",
        SECTION,
        "The zeros of the learned score obey the theorem of Poincare and Hopf: the sum of "
        "their indices is fixed by topology, as the Euler characteristic.",
        verdict,
        f"In {sum(sums)} of {len(sums)} fields the indices add up to the winding number on the "
        f"border of the box, and in {sum(as_euler)} of {len(as_euler)} regions off the path "
        "to the Euler characteristic of the region.",
    )


def _singularity_claim(rows: Sequence[Row]) -> Claim:
    zeros = [zero for row in rows for zero in row["zeros"] if zero["field"] == "score"]
    meeting = sum(row["vanishing"]["score_zeros_at_guiding_zeros"] for row in rows)
    guiding = sum(zero["field"] == "guiding" for row in rows for zero in row["zeros"])
    met = sum(row["vanishing"]["guiding_zeros_at_score_zeros"] for row in rows)
    on_path = [zero["guiding_norm"] for zero in zeros if zero["on_path"]]
    least = f"; on the path |m| is {min(on_path):.3f} or more there" if on_path else ""
    return Claim(
        "vanishing-is-singularity",
        SECTION,
        "Score vanishing is a singularity that topology forces, and one of the guiding field.",
        _by_share(meeting, len(zeros)),
        f"Of {len(zeros)} zeros of the scores of {len(rows)} robust fields {meeting} are "
        f"within a noise level of a zero of m, and topology forces "
        f"{sum(abs(region['euler']) for row in rows for region in row['regions'])}{least}. "
        f"Of {guiding} zeros of m {met} are at a zero of the score.",
    )


def _density_claim(rows: Sequence[Row]) -> Claim:
    held, asked = _held(rows, "low_density")
    held_off, asked_off = _held(rows, "low_density_off_path")
    # Most zeros are on the path by the density's own shape; the others are the question.
    verdict = _more_than_chance(held_off, asked_off)
    if verdict is Verdict.HOLDS and held < asked:
        verdict = Verdict.PARTLY
    on_path = sum(row["vanishing"]["zeros_on_path"] for row in rows)
    count = on_path + sum(row["vanishing"]["zeros_off_path"] for row in rows)
    return Claim(
        "vanishing-low-density",
        SECTION,
        "Score vanishing is pronounced where the density of samples is low.",
        verdict,
        f"In {held} of {asked} fields the zeros keep to low density: {on_path} of {count} are "
        "on the path, where it is highest. Among those off the path it is so in "
        f"{held_off} of {asked_off} fields.",
    )


def _curvature_claim(rows: Sequence[Row]) -> Claim:
    held, asked = _held(rows, "high_curvature")
    return Claim(
        "vanishing-high-curvature",
        SECTION,
        "Score vanishing is pronounced where the curvature is high.",
        _more_than_chance(held, asked),
        f"In {held} of {asked} fields on paths whose curvature varies, the zeros on the path "
        "keep to high curvature.",
    )


def _topology_claim(rows: Sequence[Row]) -> Claim:
    regions = [region for row in rows for region in row["regions"] if region["euler"] != 0]
    with_zeros = sum(region["zeros"] > 0 for region in regions)
    there = sum(region["zeros"] for region in regions)
    count = sum(
        row["vanishing"]["zeros_on_path"] + row["vanishing"]["zeros_off_path"] for row in rows
    )
    verdict = Verdict.FAILS
    if regions and with_zeros == len(regions):
        verdict = Verdict.HOLDS if there > count / 2 else Verdict.PARTLY
    return Claim(
        "vanishing-topology",
        SECTION,
        "Score vanishing is pronounced at nontrivial topology, as loops and holes.",
        verdict,
        f"{with_zeros} of {len(regions)} holes, and regions around more than one loop, hold a "
        f"zero; but {there} of all {count} zeros are there, the others are not asked for by "
        "topology.",
    )


def _parametric_claim(pieces: Sequence[Row]) -> Claim:
    found = min(min(piece["grid"], piece["least"]) for piece in pieces)
    bounded = all(
        min(piece["grid"], piece["least"]) >= (1 - SEARCH) * piece["formula"]
        for piece in pieces
    )
    verdict = Verdict.FAILS
    if found > SEARCH:
        verdict = Verdict.HOLDS if bounded else Verdict.PARTLY
    return Claim(
        "vanishing-singularity-free",
        SECTION,
        "A guiding field in one more dimension has no singularity.",
        verdict,
        f"Around {len(pieces)} pieces the least |chi| that a grid and descents found is "
        f"{found:.3f}; {'nowhere' if bounded else 'somewhere'} below what the formula says.",
    )


def _held(rows: Sequence[Row], name: str) -> tuple[int, int]:
    """In how many fields a comparison holds, and in how many it can be made."""
    verdicts = [row["vanishing"][name] for row in rows if row["vanishing"][name] is not None]
    return sum(verdict["holds"] for verdict in verdicts), len(verdicts)


def _more_than_chance(held: int, asked: int) -> Verdict:
    """Holds where all comparisons do, in part where more do than errors of 5 % explain."""
    if asked and held == asked:
        return Verdict.HOLDS
    if asked and binomtest(held, asked, ERROR, alternative="greater").pvalue < ERROR:
        return Verdict.PARTLY
    return Verdict.FAILS


def _by_share(count: int, whole: int) -> Verdict:
    if count == 0:
        return Verdict.FAILS
    return Verdict.HOLDS if count == whole else Verdict.PARTLY
