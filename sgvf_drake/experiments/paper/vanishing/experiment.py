"""Fig. 5: where the learned score vanishes, and a field that vanishes nowhere."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sgvf_drake.experiments.figures.vanishing import (
    places_figure,
    shapes_figure,
    vanishing_figure,
)
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.vanishing.claims import vanishing_claims
from sgvf_drake.experiments.paper.vanishing.tables import (
    counts_table,
    parametric_table,
    places_table,
    score_zeros,
    zeros_log,
)
from sgvf_drake.experiments.paper.vanishing.trials import (
    FIELD,
    STATES,
    ParametricTrial,
    VanishingTrial,
    measure_parametric,
    measure_score_zeros,
    parametric_fields,
)
from sgvf_drake.experiments.workbench import Record, Workbench
from sgvf_drake.fields import GuidingField, load_field

FIGURE_CAPTION = (
    "Concentric circles, robust recipe. (a) The learned score and its zeros: rows of sources, "
    "sinks and saddles along the path and midway between the circles, and one zero in the "
    "hole. (b), (c) The log-density, with the zeros of the score and of m. (d) The field in "
    "one more dimension around each circle: there the path is a helix, which agents reach and "
    "climb; |chi| is nowhere below {least:.3f}."
)
SHAPES_CAPTION = (
    "The log-density of each shape with the zeros of the learned score and of m; seed {seed}. "
    "Almost all zeros of the score are on the path, where m goes on; m vanishes in the holes "
    "and between two loops."
)
PLACES_CAPTION = (
    "All zeros of all robust fields. Left: their share up to each percentile of the density, "
    "which for places drawn evenly would be the diagonal; zeros that keep to low density "
    "would be above it. Right: |m| at the zeros of the score over the distance from the path: "
    "it is one on the path and midway between two strands, and small where a zero of m is near."
)
COUNTS_CAPTION = (
    "Zeros of the learned score in each field, means over the seeds: on the path (within three "
    "noise levels) their indices cancel, off it they add up to one. A region is a connected "
    "part of the box off the path; in each the indices add up to its Euler characteristic. "
    "Forced: the fewest zeros off the path that this allows."
)
WHERE_CAPTION = (
    "The chance that a zero of the score has a lower density, or a higher curvature of the "
    "path, than a place drawn evenly has; 0.5 where zeros do not care. In brackets the fields "
    "in which it is above 0.5 and not by accident (p < 0.05)."
)
PARAMETRIC_CAPTION = (
    "The field in one more dimension around each piece: the least |chi| on a grid of states, "
    "after descents from the lowest of them, and the root of 1 + |f'|^2 that follows from the "
    "formula; beside it the zeros of the robust field m of the shape, mean over the seeds. "
    "The speed in the plane does vanish, where a robot waits for its point."
)

Row = Mapping[str, Any]


@dataclass
class ScoreVanishing:
    """Finds where learned scores vanish, against a field that vanishes nowhere.

    Attributes:
        shapes: Those whose score the robust recipe learns, the one of the figure first.
        paper_shapes: Those of which the paper's recipe learns it as well.
        parametric_points: Waypoints, in order, of the field in one more dimension.
        effort: Part of the recipes' iterations.
        seeds: Of the waypoints' order and the networks.
    """

    shapes: list[str] = field(
        default_factory=lambda: ["concentric-circles", "separated-circles", "square", "star"]
    )
    paper_shapes: list[str] = field(default_factory=lambda: ["concentric-circles", "square"])
    parametric_points: int = 200
    effort: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        cases = [
            *((shape, "robust") for shape in self.shapes),
            *((shape, "paper") for shape in self.paper_shapes),
        ]
        trials = [
            VanishingTrial(*case, seed, self.effort) for case in cases for seed in self.seeds
        ]
        records = bench.run(measure_score_zeros, trials, "score zeros")
        by_case = {
            case: records[k * len(self.seeds) : (k + 1) * len(self.seeds)]
            for k, case in enumerate(cases)
        }
        rows = {case: [record.row for record in own] for case, own in by_case.items()}
        around = [ParametricTrial(shape, self.parametric_points) for shape in self.shapes]
        parametric = bench.run(measure_parametric, around, "fields with a parameter")
        pieces = {
            shape: record.row["pieces"]
            for shape, record in zip(self.shapes, parametric, strict=True)
        }
        return Outcome(
            exhibits=[
                *self._figures(by_case, parametric[0], pieces),
                Exhibit("vanishing_counts", COUNTS_CAPTION, counts_table(rows)),
                Exhibit("vanishing_places", WHERE_CAPTION, places_table(rows)),
                Exhibit("singularity_free", PARAMETRIC_CAPTION, parametric_table(pieces, rows)),
            ],
            claims=vanishing_claims(rows, pieces),
            logs={"score_zeros": zeros_log(rows, self.seeds)},
        )

    def _figures(
        self,
        records: Mapping[tuple[str, str], Sequence[Record]],
        parametric: Record,
        pieces: Mapping[str, Sequence[Row]],
    ) -> list[Exhibit]:
        fields = [_load(records[shape, "robust"][0]) for shape in self.shapes]
        curves = parametric_fields(ParametricTrial(self.shapes[0], self.parametric_points))
        with np.load(parametric.folder / STATES) as stored:
            flows = [stored[name] for name in sorted(stored.files)]
        least = min(piece["least"] for piece in pieces[self.shapes[0]])
        robust = [
            record.row
            for (_, recipe), own in records.items()
            if recipe == "robust"
            for record in own
        ]
        return [
            Exhibit(
                "vanishing",
                FIGURE_CAPTION.format(least=least),
                vanishing_figure(fields[0], curves, flows),
            ),
            Exhibit(
                "vanishing_shapes",
                SHAPES_CAPTION.format(seed=self.seeds[0]),
                shapes_figure(dict(zip(self.shapes, fields, strict=True))),
            ),
            Exhibit(
                "vanishing_zeros",
                PLACES_CAPTION,
                places_figure([zero for row in robust for zero in score_zeros(row)]),
            ),
        ]


def _load(record: Record) -> GuidingField:
    return load_field(record.folder / FIELD)
