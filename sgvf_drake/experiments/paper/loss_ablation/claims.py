"""What Section V-C of the paper says of its losses, and what was measured of it.

A part of a claim is found in a network where the removal of the loss changes the measure to
the side that the paper says, with the whole 95 % interval of the paired differences over the
seeds; and where the complete recipe does not show the fault itself, if the claim needs that.
A claim holds where every part is found in every network, in part where any part is found in
any network.  A single seed finds nothing.
"""

from collections.abc import Callable

import pandas as pd

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.ablation.effects import Effect, effect_of
from sgvf_drake.experiments.paper.loss_ablation.trials import (
    COMPLETE,
    NO_DIRECTION,
    NO_ORTHOGONALITY,
    NO_UNIT,
    VARIANTS,
)

SOURCE = "Section V-C, Fig. 4"

Parts = dict[str, tuple[bool, Effect]]
"""The parts of a claim: whether each was found, and the effect that says so."""


def loss_claims(table: pd.DataFrame) -> list[Claim]:
    """Returns the claims of the ablation of the losses.

    Args:
        table: One row a network, variant and seed; see `ablation_tables.field_table`.
    """
    return [
        _complete(table),
        _claim(
            table,
            unit_parts,
            "unit-length",
            f"{SOURCE} (a)",
            "Without the unit length loss the tangent has uncontrolled magnitudes; that it "
            "dominates near the path and diminishes away from it is disrupted.",
        ),
        _claim(
            table,
            orthogonality_parts,
            "orthogonality",
            f"{SOURCE} (b)",
            "Without the orthogonality loss the tangent does not follow the path, and "
            "diverges away from it.",
        ),
        _claim(
            table,
            direction_parts,
            "directional-consistency",
            f"{SOURCE} (c)",
            "Without the directional consistency loss the tangent has two conflicting "
            "directions, with one line a source and another a sink.",
        ),
    ]


def unit_parts(table: pd.DataFrame) -> Parts:
    """Returns the parts of (a) in one network.

    Magnitudes are uncontrolled where the longest v of the box is longer; the length of m is
    the loss that was removed, and says nothing.
    That v dominates near the path and diminishes away from it is read in two ways: as |v|
    near over |v| away, which is above one in the complete recipe and falls; and as v being
    longer than s in less than half of what is away, and in more of it without the loss.
    """
    longest = effect_of(table, "lengths.v_box_max", NO_UNIT, factor=True)
    fading = effect_of(table, "lengths.fading", NO_UNIT, factor=True)
    leads = effect_of(table, "lengths.leads_away", NO_UNIT)
    return {
        "longest v in the box": (longest.rises, longest),
        "|v| near the path over |v| away": (
            fading.complete[1] > 1 and fading.falls,
            fading,
        ),
        "share of what is away where v is longer than s": (
            leads.complete[0] < 0.5 and leads.rises,
            leads,
        ),
    }


def orthogonality_parts(table: pd.DataFrame) -> Parts:
    """Returns the parts of (b) in one network.

    v does not follow the path where going along it leads farther off; it diverges where its
    mean component away from the path is above zero, and above that of the complete recipe;
    m does not follow where fewer agents complete a lap.
    """
    drift = effect_of(table, "drift.drift_u", NO_ORTHOGONALITY)
    outward = effect_of(table, "drift.outward", NO_ORTHOGONALITY)
    lap = effect_of(table, "following.lap", NO_ORTHOGONALITY)
    return {
        "U off the path after 3 U along v": (drift.rises, drift),
        "mean part of v away from the path": (
            outward.removed[1] > 0 and outward.rises,
            outward,
        ),
        "share of agents that lap": (lap.falls, lap),
    }


def direction_parts(table: pd.DataFrame) -> Parts:
    """Returns the parts of (c) in one network.

    There are conflicting directions where more rings are not run through one way, and none
    is that way in the complete recipe; one line of each kind where the rings of every
    seed have one source on average, to a half.
    """
    conflicted = effect_of(table, "tangent.conflicted", NO_DIRECTION)
    sources = effect_of(table, "tangent.sources", NO_DIRECTION)
    here = table.loc[table["variant"] == NO_DIRECTION, "tangent.sources"]
    return {
        "share of rings with two directions": (
            conflicted.rises and conflicted.complete[0] == 0,
            conflicted,
        ),
        "sources of a ring": (
            sources.rises and bool((abs(here - 1) <= 0.5).all()),
            sources,
        ),
    }


def _claim(
    table: pd.DataFrame,
    parts_of: Callable[[pd.DataFrame], Parts],
    key: str,
    source: str,
    statement: str,
) -> Claim:
    parts = {
        str(network): parts_of(fields)
        for network, fields in table.groupby("network", sort=False)
    }
    found = [there for here in parts.values() for there, _ in here.values()]
    evidence = " ".join(f"{network}: {_told(here)}." for network, here in parts.items())
    return Claim(key, source, statement, Verdict.of(found), evidence)


def _told(parts: Parts) -> str:
    return "; ".join(
        f"{name} {effect}, {'found' if there else 'not found'}"
        for name, (there, effect) in parts.items()
    )


def _complete(table: pd.DataFrame) -> Claim:
    """The claim that the others stand on: with all losses the field can be followed.

    It holds where every seed of every network is followable, in part where any is.
    """
    fields = table[table["variant"] == COMPLETE]
    followable = fields["following.followable"].astype(bool)
    told = "; ".join(
        f"{network}: " + ", ".join(_counted(rows, variant) for variant in VARIANTS)
        for network, rows in table.groupby("network", sort=False)
    )
    return Claim(
        "all-losses",
        "Section V-C",
        "With all three losses the guiding field is reliable; measured by more than the two "
        "agents of the paper: all starts of a grid follow the rings all the way around.",
        Verdict.of(followable),
        f"Seeds in which every start completes a lap: {told}.",
    )


def _counted(table: pd.DataFrame, variant: str) -> str:
    seeds = table[table["variant"] == variant]["following.followable"]
    return f"{variant} {int(seeds.sum())} of {len(seeds)}"
