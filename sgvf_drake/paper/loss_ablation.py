"""Fig. 4: the paper's recipe, and what each of its losses is for (Section V-C).

A part of a claim is found in a network where the removal of the loss changes the measure to
the side that the paper says, with the whole 95 % interval of the paired differences over the
seeds; and where the complete recipe does not show the fault itself, if the claim needs that.
A claim holds where every part is found in every network, in part where any part is found in
any network.  A single seed finds nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sgvf_drake.experiments.intervals import POSITIVE, SHARE
from sgvf_drake.paper.ablation import (
    ANY,
    COMPLETE,
    FIELDS,
    FOLLOWED,
    Ablation,
    Effect,
    MeasurePanel,
    effect_of,
)
from sgvf_drake.paper.claims import Claim, Claims, Count, Judged, Rows, Verdict
from sgvf_drake.paper.experiment import SeedsTable, count, first

PANELS = (
    MeasurePanel("lengths.v_box_max", "longest $v$ in the box", log=True),
    MeasurePanel("lengths.fading", "mean $|v|$ near / away from the path", log=True),
    MeasurePanel("drift.beside_cosine", "mean $|\\cos(s, v)|$ beside the path", SHARE),
    MeasurePanel("drift.drift_u", "off the path after 3 U along $v$ [U]"),
    MeasurePanel("tangent.sources", "sources of $v$ on a ring"),
    MeasurePanel("following.lap", "share of starts that lap", SHARE),
)
TABLES = (
    SeedsTable(
        "following",
        "The fields followed from a grid of starts: a field is followable when every start "
        "completes a lap and both rings have some. The shallow and the deep network stand "
        "apart, since either may fail with all losses; means with 95 % intervals over the "
        "seeds.",
        {
            "followable seeds": ("following.followable", count),
            **FOLLOWED,
            "slowest |m| on the path": ("following.speed_min", POSITIVE),
        },
    ),
    SeedsTable(
        "claims",
        "What the paper says of each loss, measured: lengths of m and v (near: within 0.1 U "
        "of the path, away: beyond 1 U), whether v leads along the path or off it, and where "
        "v turns around on a ring.",
        {
            "longest v, box": ("lengths.v_box_max", POSITIVE),
            "RMS of |m| - 1, box": ("lengths.m_error", POSITIVE),
            "|v| near / away": ("lengths.fading", POSITIVE),
            "|v| > |s|, away": ("lengths.leads_away", SHARE),
            "|cos(s, v)| beside": ("drift.beside_cosine", SHARE),
            "outward part of v": ("drift.outward", ANY),
            "off after 3 U along v, U": ("drift.drift_u", POSITIVE),
            "sources of v a ring": ("tangent.sources", POSITIVE),
            "rings of two ways, v": ("tangent.conflicted", SHARE),
            "rings of two ways, m": ("whole.conflicted", SHARE),
        },
    ),
    SeedsTable(
        "checks",
        "The same fields in the sampled Lyapunov checks: whether there is a band of levels on "
        "which V falls around a tube along each ring, and what speaks against it near the "
        "path.",
        {
            "holds": ("check.holds", count),
            "has a band": ("check.band", count),
            "zeros of m near the path": ("check.zeros", POSITIVE),
            "smallest |m| there": ("check.slowest", POSITIVE),
            "V falls, part of the box": ("check.falls", SHARE),
            "eps = |cos(s, v)|, box": ("check.cosine", SHARE),
            "| |m| - 1 |, box": ("check.length_error", POSITIVE),
            "first seed": ("check.reason", first),
        },
    ),
)


@dataclass
class LossAblation(Ablation):
    """Trains the paper's recipe with all losses and without each, on the same scores.

    Attributes:
        shape: A named shape of closed pieces.
        networks: Hidden widths of the tangent networks.
        patience: The time of the agents to run, in the usual one: the paper's fields are slow.
    """

    shape: str = "concentric-circles"
    networks: list[list[int]] = field(default_factory=lambda: [[128], [64, 64, 64, 64]])
    patience: float = 4.0

    group = "network"
    symbol = "v"
    span = (0.05, 5.0)
    captions = (
        "The tangent field v with all losses and without each, seed {}: arrows of one length, "
        "the colour, also of the waypoints, is |v|. Triangles mark where v turns around on "
        "the path, red dots where agents of m = s + v ended that completed no lap.",
        "The measures of the claims, every seed and means with 95 % intervals: what the "
        "removal of a loss changes beyond the scatter of the seeds. On logarithmic axes the "
        "means are geometric.",
    )
    panels = PANELS
    seeds_tables = TABLES

    def cells(self) -> Sequence[Mapping[str, Any]]:
        variants = ("no-unit", "no-orthogonality", "no-direction")
        own = {"recipe": "paper", "shape": self.shape, "patience": self.patience}
        return [
            {**own, "hidden": tuple(hidden), "variants": variants} for hidden in self.networks
        ]

    def claims(self) -> Sequence[Claim]:
        return CLAIMS


@dataclass(frozen=True)
class Part:
    """Something that a claim says of a field without a loss.

    Attributes:
        name: What is measured.
        column: The column of the measure.
        shows: Whether the effect of the removal shows it.
        factor: Whether the change is a factor; see `effect_of`.
    """

    name: str
    column: str
    shows: Callable[[Effect], bool]
    factor: bool = False


CLAIMS = Claims()


@CLAIMS.add("all-losses", "Section V-C")
def _laps(rows: Rows) -> Judged:
    """With all three losses the guiding field is reliable; measured by more than the two agents
    of the paper: all starts of a grid follow the rings all the way around.
    """
    # Counts the fields in which every start completes a lap: complete, and all variants.
    fields = rows[FIELDS]
    complete = fields.loc[fields["variant"] == COMPLETE, "following.followable"]
    lapped = Count.of(complete)
    return {"every start laps, complete": lapped} | {
        f"{network} {variant}": Count.of(own["following.followable"])
        for (network, variant), own in fields.groupby(["network", "variant"], sort=False)
    }, Verdict.every(lapped)


def _find_parts(rows: Rows, variant: str, *parts: Part) -> Judged:
    """Tells the effect of a removed loss on each part of a claim, in each network."""
    told, found = {}, []
    for network, fields in rows[FIELDS].groupby("network", sort=False):
        for part in parts:
            effect = effect_of(fields, part.column, variant, factor=part.factor)
            found.append(part.shows(effect))
            verdict = "found" if found[-1] else "not found"
            told[f"{network} {part.name}"] = f"{effect}, {verdict}"
    count = Count.of(found)
    return {"parts found": count, **told}, Verdict.every(count)


@CLAIMS.add("unit-length", "Section V-C, Fig. 4 (a)")
def _unit_length(rows: Rows) -> Judged:
    """Without the unit length loss the tangent has uncontrolled magnitudes; that it dominates
    near the path and diminishes away from it is disrupted.
    """
    # Magnitudes are uncontrolled where the longest v of the box is longer; the length of m is
    # the loss that was removed, and says nothing.  That v dominates near the path and
    # diminishes away from it is read in two ways: as |v| near over |v| away, which is above
    # one in the complete recipe and falls; and as v being longer than s in less than half of
    # what is away, and in more of it without the loss.
    return _find_parts(
        rows,
        "no-unit",
        Part("longest v in the box", "lengths.v_box_max", Effect.rises, factor=True),
        Part(
            "|v| near the path over |v| away",
            "lengths.fading",
            lambda effect: effect.complete[0] > 1 and effect.falls(),
            factor=True,
        ),
        Part(
            "share of what is away where v is longer than s",
            "lengths.leads_away",
            lambda effect: effect.complete[0] < 0.5 and effect.rises(),
        ),
    )


@CLAIMS.add("orthogonality", "Section V-C, Fig. 4 (b)")
def _orthogonality(rows: Rows) -> Judged:
    """Without the orthogonality loss the tangent does not follow the path, and diverges away
    from it.
    """
    # v does not follow the path where going along it leads farther off; it diverges where its
    # mean component away from the path is above zero, and above that of the complete recipe;
    # m does not follow where fewer agents complete a lap.
    return _find_parts(
        rows,
        "no-orthogonality",
        Part("U off the path after 3 U along v", "drift.drift_u", Effect.rises),
        Part(
            "mean part of v away from the path",
            "drift.outward",
            lambda effect: effect.removed[1] > 0 and effect.rises(),
        ),
        Part("share of agents that lap", "following.lap", Effect.falls),
    )


@CLAIMS.add("directional-consistency", "Section V-C, Fig. 4 (c)")
def _directional_consistency(rows: Rows) -> Judged:
    """Without the directional consistency loss the tangent has two conflicting directions, with
    one line a source and another a sink.
    """
    # There are conflicting directions where more rings are not run through one way, and none
    # is that way in the complete recipe; one line of each kind where the rings of every seed
    # have one source on average, to a half.
    return _find_parts(
        rows,
        "no-direction",
        Part(
            "share of rings with two directions",
            "tangent.conflicted",
            lambda effect: effect.rises() and effect.complete[0] == 0,
        ),
        Part(
            "sources of a ring",
            "tangent.sources",
            lambda effect: effect.rises() and all(abs(x - 1) <= 0.5 for x in effect.seeds),
        ),
    )
