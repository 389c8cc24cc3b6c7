"""Fig. 4: the paper's recipe, and what each of its losses is for."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import pandas as pd

from sgvf_drake.experiments.figures.ablation import (
    MeasurePanel,
    measures_figure,
    variants_figure,
)
from sgvf_drake.paper.intervals import POSITIVE, SHARE
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.ablation.panels import panels_of
from sgvf_drake.experiments.paper.ablation.tables import (
    ANY,
    FOLLOWED,
    field_table,
    seeds_table,
)
from sgvf_drake.experiments.paper.loss_ablation.claims import loss_claims
from sgvf_drake.experiments.paper.loss_ablation.trials import (
    COMPLETE,
    NO_DIRECTION,
    NO_ORTHOGONALITY,
    NO_UNIT,
    LossTrial,
    measure_losses,
)
from sgvf_drake.experiments.workbench import Record, Workbench
from sgvf_drake.fields import TangentField
from sgvf_drake.lyapunov.band import SIGMA_RATIOS

NAMES = {
    COMPLETE: "complete",
    NO_UNIT: "no unit length",
    NO_ORTHOGONALITY: "no orthogonality",
    NO_DIRECTION: "no directional consistency",
}
# Lengths of v that are told apart by colour.
SPAN = (0.05, 5.0)
PANELS = (
    MeasurePanel("lengths.v_box_max", "longest $v$ in the box", log=True),
    MeasurePanel("lengths.fading", "mean $|v|$ near / away from the path", log=True),
    MeasurePanel("drift.beside_cosine", "mean $|\\cos(s, v)|$ beside the path", SHARE),
    MeasurePanel("drift.drift_u", "off the path after 3 U along $v$ [U]"),
    MeasurePanel("tangent.sources", "sources of $v$ on a ring"),
    MeasurePanel("following.lap", "share of starts that lap", SHARE),
)
FOLLOWING_CAPTION = (
    "The fields followed from a grid of starts: a field is followable when every start "
    "completes a lap and both rings have some. The shallow and the deep network stand apart, "
    "since either may fail with all losses; means with 95 % intervals over the seeds."
)
CLAIMS_CAPTION = (
    "What the paper says of each loss, measured: lengths of m and v (near: within 0.1 U of "
    "the path, away: beyond 1 U), whether v leads along the path or off it, and where v "
    "turns around on a ring."
)
CHECKS_CAPTION = (
    "The same fields in the sampled Lyapunov checks: whether there is a band of levels on "
    "which V falls around a tube along each ring, and what speaks against it near the path."
)


@dataclass
class LossAblation:
    """Trains the paper's recipe with all losses and without each, on the same scores.

    Attributes:
        shape: A named shape of closed pieces.
        networks: Hidden widths of the tangent networks.
        starts: Agents on a grid over the box.
        patience: Their time to run, in the usual one: the paper's fields are slow.
        ratios: The noise levels of V that the sublevel checks try, in those of the field.
        score_iterations: Optimisation steps of the score network.
        tangent_iterations: Of each tangent network.
        seeds: Of the clouds and the trainings; the first is drawn.
    """

    shape: str = "concentric-circles"
    networks: list[list[int]] = field(default_factory=lambda: [[128], [64, 64, 64, 64]])
    starts: int = 100
    patience: float = 4.0
    ratios: list[float] = field(default_factory=lambda: list(SIGMA_RATIOS))
    score_iterations: int = 10_000
    tangent_iterations: int = 10_000
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        trials = [
            LossTrial(
                shape=self.shape,
                seed=seed,
                hidden=tuple(hidden),
                starts=self.starts,
                patience=self.patience,
                ratios=tuple(self.ratios),
                score_iterations=self.score_iterations,
                tangent_iterations=self.tangent_iterations,
            )
            for seed in self.seeds
            for hidden in self.networks
        ]
        records = bench.run(measure_losses, trials, "losses")
        labels = [{"network": widths(t.hidden), "seed": t.seed} for t in trials]
        table = field_table(labels, records)
        return Outcome(
            exhibits=[
                self._fields(records),
                Exhibit(
                    "measures",
                    "The measures of the claims, every seed and means with 95 % intervals: "
                    "what the removal of a loss changes beyond the scatter of the seeds. On "
                    "logarithmic axes the means are geometric.",
                    measures_figure(table, PANELS, "network", NAMES),
                ),
                Exhibit("following", FOLLOWING_CAPTION, following_table(table)),
                Exhibit("claims", CLAIMS_CAPTION, claims_table(table)),
                Exhibit("checks", CHECKS_CAPTION, checks_table(table)),
            ],
            claims=loss_claims(table),
            logs={"fields": table},
        )

    def _fields(self, records: Sequence[Record]) -> Exhibit:
        """Draws the tangent fields of the first seed (paper, Fig. 4)."""
        drawn = zip(self.networks, records, strict=False)
        rows = {
            f"v by {widths(hidden)}": panels_of(record.folder, self.shape, NAMES, TangentField)
            for hidden, record in drawn
        }
        return Exhibit(
            "fields",
            f"The tangent field v with all losses and without each, seed {self.seeds[0]}: "
            "arrows of one length, the colour, also of the waypoints, is |v|. Triangles mark "
            "where v turns around on the path, red dots where agents of m = s + v ended that "
            "completed no lap.",
            variants_figure(rows, "v", SPAN),
        )


def widths(hidden: Sequence[int]) -> str:
    """Returns a planar tangent network as the paper writes it: [2,128,2]."""
    return f"[{','.join(map(str, (2, *hidden, 2)))}]"


def following_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns how well each variant is followed."""
    return seeds_table(
        table,
        ("network", "variant"),
        NAMES,
        counts={"followable seeds": "following.followable"},
        means={
            **FOLLOWED,
            "slowest |m| on the path": ("following.speed_min", POSITIVE),
        },
    )


def claims_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns the measures of the claims for each variant."""
    return seeds_table(
        table,
        ("network", "variant"),
        NAMES,
        counts={},
        means={
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
    )


def checks_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns what the sublevel checks find, with the reason of the first seed."""
    found = seeds_table(
        table,
        ("network", "variant"),
        NAMES,
        counts={"holds": "check.holds", "has a band": "check.band"},
        means={
            "zeros of m near the path": ("check.zeros", POSITIVE),
            "smallest |m| there": ("check.slowest", POSITIVE),
            "V falls, part of the box": ("check.falls", SHARE),
            "eps = |cos(s, v)|, box": ("check.cosine", SHARE),
            "| |m| - 1 |, box": ("check.length_error", POSITIVE),
        },
    )
    firsts = table.groupby(["network", "variant"], sort=False)["check.reason"].first()
    return found.assign(**{"first seed": firsts.to_numpy()})
