"""What Section VI-B says of corners, against what was measured."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from sgvf_drake.paper.intervals import SHARE, interval
from sgvf_drake.experiments.outcome import Claim, Verdict

SECTION = "Section VI-B"
SQUARE, HEXAGON = 4, 6
# The chance that a correlation is found by accident.
SIGNIFICANCE = 0.05
# Below this a part of the field counts as vanishing; `sgvf verify` asks as much of m.
SMALL = 0.05


def corner_claims(table: pd.DataFrame, tangent_at_traps: Sequence[float]) -> list[Claim]:
    """Returns the claims.

    Args:
        table: One row a field: corners, angle, network, seed, even and the figures of
            `corners_traps.examine`; with the square and the hexagon.
        tangent_at_traps: |v| at the traps near corners of the shallow fields.
    """
    shallow = table[table["network"] == "shallow"]
    square, hexagon = (shallow[shallow["corners"] == corners] for corners in (SQUARE, HEXAGON))
    both = table[table["corners"].isin([SQUARE, HEXAGON])]
    return [
        _stall_claim(square),
        _hexagon_claim(square, hexagon),
        _deep_claim(*(both[both["network"] == name] for name in ("shallow", "deep"))),
        _pause_claim(both[both["network"] == "shallow"]),
        _angle_claim(shallow),
        _tangent_claim(tangent_at_traps),
    ]


def _stall_claim(square: pd.DataFrame) -> Claim:
    stalled, near = interval(square["stalled_near"], SHARE), interval(square["near"], SHARE)
    even = float(square["even"].iloc[0])
    verdict = Verdict.PARTLY if stalled[0] > 0 else Verdict.FAILS
    # The interval of a single value, NaN, shows nothing.
    if stalled[1] > 0 and near[1] > even:
        verdict = Verdict.HOLDS
    where = ""
    if not np.isnan(near[0]):
        where = f"; {_share(near)} of those that stall do, where {even:.0%} of the path is"
    return Claim(
        "corners-shallow-square",
        f"{SECTION}, Fig. 6 (a)",
        "With a shallow tangent network agents stall near the corners of a square.",
        verdict,
        f"{_share(stalled)} of the starts stall within 0.5 U of a corner, in "
        f"{(square['stalled_near'] > 0).sum()} of {len(square)} fields{where}.",
    )


def _hexagon_claim(square: pd.DataFrame, hexagon: pd.DataFrame) -> Claim:
    pairs = square.merge(hexagon, on="seed", suffixes=("", "_hexagon"))
    less = interval(pairs["stalled_near"] - pairs["stalled_near_hexagon"], (-1.0, 1.0))
    near, there = (interval(rows["stalled_near"], SHARE) for rows in (square, hexagon))
    verdict = Verdict.HOLDS if less[1] > 0 else Verdict.FAILS
    return Claim(
        "corners-hexagon-less",
        f"{SECTION}, Fig. 6 (b)",
        "With a shallow network the corners of a hexagon trap less than those of a square.",
        verdict,
        f"{_share(near)} of the starts stall near a corner of the "
        f"square, {_share(there)} near one of the hexagon; the "
        f"difference is {_share(less)}. A trap is near {square['trapped'].mean():.0%} of the "
        f"corners of the square and {hexagon['trapped'].mean():.0%} of the hexagon's.",
    )


def _deep_claim(shallow: pd.DataFrame, deep: pd.DataFrame) -> Claim:
    pairs = shallow.merge(deep, on=["corners", "seed"], suffixes=("", "_deep"))
    # Where the field runs against itself, a trap is not the corner's.
    less = interval(pairs["trapped_locally"] - pairs["trapped_locally_deep"])
    verdict = Verdict.PARTLY if less[1] > 0 else Verdict.FAILS
    is_free = not (deep["trapped_locally"] > 0).any() and not deep["undecided"].any()
    if is_free and not (deep["stalled_near"] > 0).any():
        verdict = Verdict.HOLDS
    hexagon = deep[deep["corners"] == HEXAGON]
    return Claim(
        "corners-deep-eliminates",
        f"{SECTION}, Fig. 6 (c)",
        "A deeper tangent network eliminates corner attraction entirely.",
        verdict,
        f"A corner traps in {(deep['trapped_locally'] > 0).sum()} of {len(deep)} deep fields "
        f"(hexagons: {(hexagon['trapped_locally'] > 0).sum()} of {len(hexagon)}) and in "
        f"{(shallow['trapped_locally'] > 0).sum()} of {len(shallow)} shallow ones; of all "
        f"corners {deep['trapped_locally'].mean():.0%} against "
        f"{shallow['trapped_locally'].mean():.0%} do. "
        f"{deep['stalled_near'].mean():.0%} of the starts stall near a corner, against "
        f"{shallow['stalled_near'].mean():.0%}; in {(deep['turns'] > 0).sum()} deep fields "
        "the sides do not all run the same way around.",
    )


def _pause_claim(shallow: pd.DataFrame) -> Claim:
    slow = interval(shallow["speed_corner"] / shallow["speed_side"])
    paused, stalled = shallow["paused"].mean(), shallow["stalled"].mean()
    verdict = Verdict.FAILS
    if slow[2] < 1:
        verdict = Verdict.HOLDS if paused > 0 and stalled == 0 else Verdict.PARTLY
    return Claim(
        "corners-pauses",
        SECTION,
        "A shallow network traps the agent for a while: it pauses and goes on.",
        verdict,
        f"Near corners |m| falls to {_share(slow)} of what it falls to about the middle of a "
        f"side. {paused:.1%} of the agents on squares and hexagons stand still for a while and "
        f"go on, {stalled:.0%} never go on.",
    )


def _angle_claim(shallow: pd.DataFrame) -> Claim:
    correlation, p_value = 0.0, 1.0
    if len(shallow) > 2 and min(shallow[["angle", "trapped"]].nunique()) > 1:
        correlation, p_value = map(float, spearmanr(shallow["angle"], shallow["trapped"]))
    significant = correlation < 0 and p_value < SIGNIFICANCE
    verdict = Verdict.HOLDS if significant else Verdict.FAILS
    by_angle = shallow.groupby("angle")["trapped"].mean()
    parts = ", ".join(f"{share:.0%} at {angle:g}" for angle, share in by_angle.items())
    return Claim(
        "corners-sharper",
        SECTION,
        "With a shallow network sharp corners trap more than gentle ones.",
        verdict,
        f"Corners with a trap: {parts} degrees; rank correlation with the angle "
        f"{correlation:.2f} (p = {p_value:.2g}) over {len(shallow)} fields.",
    )


def _tangent_claim(norms: Sequence[float]) -> Claim:
    small = np.array(norms) < SMALL
    verdict = Verdict.PARTLY if small.any() else Verdict.FAILS
    if len(norms) and small.all():
        verdict = Verdict.HOLDS
    return Claim(
        "corners-tangent-attractor",
        SECTION,
        "The traps of shallow networks are local attractors of the tangent field.",
        verdict,
        f"At {len(norms)} traps near corners |v|, which the score cancels there, is "
        f"{np.min(norms):.2f} to {np.max(norms):.2f}, and below {SMALL} at {small.sum()}."
        if len(norms)
        else "No trap is near a corner.",
    )


def _share(values: tuple[float, float, float]) -> str:
    mean, low, high = values
    if np.isnan(low):
        return f"{mean:.0%}"
    return f"{mean:.0%} [{low:.0%}, {high:.0%}]"
