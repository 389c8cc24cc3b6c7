"""Fig. 1: ordered, shuffled and branching waypoints, for classical methods and for SGVF."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise, product

from matplotlib.figure import Figure
import numpy as np
import pandas as pd

from sgvf_drake.experiments.figures.indexing import Agents, IndexingColumn, indexing_figure
from sgvf_drake.paper.intervals import SHARE, interval_columns
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.baselines.trials import (
    TRAJECTORIES,
    BaselineTrial,
    measure_baseline,
)
from sgvf_drake.experiments.paper.indexing.claims import LABELS, indexing_claims, label
from sgvf_drake.experiments.paper.indexing.trials import (
    CURVES,
    FIELD,
    CurveTrial,
    LearnedTrial,
    curve_points,
    make_waypoints,
    measure_curve,
    measure_learned,
)
from sgvf_drake.experiments.workbench import Record, Row, Workbench
from sgvf_drake.fields import FloatArray, GaussianMixture, GuidingField, load_field
from sgvf_drake.metrics import grid_starts

GIVEN = ("ordered", "shuffled", "branching")
# The curve whose field is drawn with its agents; the other is off the paper.
DRAWN = "fourier"
# Points of the box at which fields are compared.
GRID = 2_500

FIGURE_CAPTION = (
    "Top: curves through waypoints in the order in which they are given, on a smooth closed "
    "path, the same shuffled, and three arms given one after the other. Below: agents from a "
    "grid in the classical field of the Fourier curve through all waypoints, and in the field "
    "learned from them; red ones fail."
)
CURVES_CAPTION = (
    "Length of the interpolated curve over that of the true path, and its largest distance "
    "from it; shuffled over several orders. Polynomials through many equally spaced waypoints "
    "swing beyond all bounds in whatever order."
)
AGENTS_CAPTION = (
    "Agents from a grid over the box, 200 waypoints; over the seeds. On the closed path an "
    "agent succeeds when it laps it, on the arms when it stays near them and stops nowhere "
    "but at a tip; coverage is the share of waypoints that those pass."
)
ORDER_CAPTION = (
    "By how much fields differ that were trained on two orders of the same waypoints with the "
    "same seed, beside those of two seeds on ordered waypoints (root mean square of the "
    "difference of m, where |m| = 1). The exact score does not depend on the order at all."
)


Group = tuple[str, str]
"""Case and field."""


@dataclass
class Indexing:
    """Puts ordered, shuffled and branching waypoints to interpolation and to SGVF.

    Attributes:
        recipe: Of the learned fields.
        thinning: Curves go through every so many-th waypoint of 200; those of the first one
            are drawn.
        starts: Agents on a grid over the box.
        seeds: Of the orders and the trainings.
    """

    recipe: str = "robust"
    thinning: list[int] = field(default_factory=lambda: [8, 1])
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        curves = self._curves(bench)
        agents = self._classical(bench)
        learned = self._learned(bench)
        changes = field_changes(
            [load_field(record.folder / FIELD) for record in learned["ordered"]],
            [load_field(record.folder / FIELD) for record in learned["shuffled"]],
        )
        # The last of the ordered ones is only there to compare its field with.
        learned["ordered"] = learned["ordered"][:-1]
        agents |= {(case, self.recipe): records for case, records in learned.items()}
        rows = {key: [record.row for record in own] for key, own in agents.items()}
        return Outcome(
            exhibits=[
                Exhibit("indexing", FIGURE_CAPTION, self._figure(agents)),
                Exhibit("indexing_curves", CURVES_CAPTION, curves_table(curves)),
                Exhibit("indexing_agents", AGENTS_CAPTION, agents_table(rows)),
                Exhibit("indexing_order", ORDER_CAPTION, order_table(changes)),
            ],
            claims=indexing_claims(
                curves,
                rows,
                self.recipe,
                {key: [change["m, box"] for change in own] for key, own in changes.items()},
            ),
        )

    def _curves(self, bench: Workbench) -> list[Row]:
        """Returns one row a curve; only shuffling depends on the seed."""
        trials = [
            CurveTrial(case, curve, thinning, seed)
            for case, curve, thinning in product(GIVEN, CURVES, self.thinning)
            for seed in (self.seeds if case == "shuffled" else self.seeds[:1])
        ]
        records = bench.run(measure_curve, trials, "indexing, curves")
        return [
            {**asdict(trial), **record.row}
            for trial, record in zip(trials, records, strict=True)
        ]

    def _classical(self, bench: Workbench) -> dict[Group, list[Record]]:
        groups = {
            (case, curve): self.seeds if case == "shuffled" else self.seeds[:1]
            for case, curve in product(GIVEN, CURVES)
        }
        trials = [
            BaselineTrial(*group, seed, self.starts)
            for group, seeds in groups.items()
            for seed in seeds
        ]
        records = iter(bench.run(measure_baseline, trials, "indexing, classical fields"))
        return {group: [next(records) for _ in seeds] for group, seeds in groups.items()}

    def _learned(self, bench: Workbench) -> dict[str, list[Record]]:
        """Returns the records of each case; those of ordered waypoints have one seed more."""
        seeds = dict.fromkeys(GIVEN, self.seeds)
        seeds["ordered"] = [*self.seeds, max(self.seeds) + 1]
        trials = [
            LearnedTrial(case, self.recipe, seed, self.starts)
            for case, own in seeds.items()
            for seed in own
        ]
        records = iter(bench.run(measure_learned, trials, "indexing, learned fields"))
        return {case: [next(records) for _ in own] for case, own in seeds.items()}

    def _figure(self, agents: Mapping[Group, Sequence[Record]]) -> Figure:
        columns = []
        for case in GIVEN:
            cloud, _ = make_waypoints(CurveTrial(case, DRAWN, self.thinning[0], self.seeds[0]))
            columns.append(
                IndexingColumn(
                    case,
                    cloud.normalize(cloud.points),
                    {
                        LABELS[curve]: cloud.normalize(curve_points(curve, cloud))
                        for curve in CURVES
                    },
                    [
                        _agents(f"{case}, {label}", agents[case, key][0])
                        for label, key in (("Fourier field", DRAWN), ("SGVF", self.recipe))
                    ],
                )
            )
        return indexing_figure(columns)


def field_changes(
    ordered: Sequence[GuidingField], shuffled: Sequence[GuidingField]
) -> dict[str, list[dict[str, float]]]:
    """Returns by how much fields differ: `order`, between two orders; `seed`, two seeds.

    Args:
        ordered: Fields of ordered waypoints, with one seed after the other.
        shuffled: Fields of the same waypoints shuffled, with the same seeds but the last.
    """
    return {
        "order": [_change(a, b) for a, b in zip(ordered[:-1], shuffled, strict=True)],
        "seed": [_change(a, b) for a, b in pairwise(ordered)],
    }


def _change(a: GuidingField, b: GuidingField) -> dict[str, float]:
    """Returns root mean square differences, of m and of sigma times the exact score."""
    box = grid_starts(a.cloud.box, GRID, a.dim)
    scores = [
        GaussianMixture(field.cloud.points, field.mixture.sigma).score(box) for field in (a, b)
    ]
    return {
        "m, waypoints": _rms(a(a.cloud.points) - b(a.cloud.points)),
        "m, box": _rms(a(box) - b(box)),
        "exact score, box": a.mixture.sigma * _rms(scores[0] - scores[1]),
    }


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _agents(label: str, record: Record) -> Agents:
    with np.load(record.folder / TRAJECTORIES) as stored:
        return Agents(label, stored["points"], stored["positions"], stored["good"])


def curves_table(curves: Sequence[Row]) -> pd.DataFrame:
    """Returns one row a case, curve and number of waypoints."""
    groups = pd.DataFrame(curves).groupby(["case", "curve", "waypoints"], sort=False)
    return pd.DataFrame(
        {
            "case": case,
            "curve": LABELS[str(curve)],
            "waypoints": waypoints,
            **interval_columns("length over true", own["length_ratio"]),
            **interval_columns("farthest from path, U", own["farthest_u"]),
        }
        for (case, curve, waypoints), own in groups
    )


def agents_table(rows: Mapping[Group, Sequence[Row]]) -> pd.DataFrame:
    """Returns one row a case and field."""
    return pd.DataFrame(
        {
            "case": case,
            "field": label(field),
            **interval_columns("success", [row["success"] for row in own], SHARE),
            **interval_columns("coverage", [row["coverage"] for row in own], SHARE),
        }
        for (case, field), own in rows.items()
    )


def order_table(changes: Mapping[str, Sequence[Mapping[str, float]]]) -> pd.DataFrame:
    """Returns one row a kind of change."""
    names = {"order": "another order", "seed": "another seed"}
    return pd.DataFrame(
        {"change": names[kind]}
        | {
            column: value
            for key in own[0]
            for column, value in interval_columns(key, [one[key] for one in own]).items()
        }
        for kind, own in changes.items()
    )
