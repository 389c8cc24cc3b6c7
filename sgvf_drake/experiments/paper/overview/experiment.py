"""Fig. 2: score, tangent, losses and two agents, on the two shapes of the paper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from sgvf_drake.experiments.figures.overview import OverviewRow, overview_figure
from sgvf_drake.paper.intervals import SHARE, fraction_columns, interval_columns
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.overview.claims import followed, overview_claims
from sgvf_drake.experiments.paper.overview.losses import losses_table, tangent_courses
from sgvf_drake.experiments.paper.overview.trials import (
    AGENTS,
    FIELD,
    LOSSES,
    OverviewTrial,
    measure_overview,
)
from sgvf_drake.experiments.workbench import Record, Workbench
from sgvf_drake.fields import load_field

FIELDS_CAPTION = (
    "Agents from a grid over the box in every trained field, over the seeds. A field is "
    "followed where all starts lap, and on both pieces. RMS and largest distance from the "
    "path are over the last lap of those that settled; |m| is the speed on the path at a "
    "commanded speed of one. The robust recipe may start again, the paper's does not."
)
LOSSES_CAPTION = (
    "The losses of the tangent network, each times its weight, mean over the seeds: in the "
    "first and the last tenth of the training, the change of the last from the tenth before, "
    "and the highest tenth of the second half; both in per cent of the last."
)

Group = tuple[str, str]
"""Shape and recipe."""

T = TypeVar("T")


@dataclass
class Overview:
    """Trains and follows the two headline shapes in several recipes.

    Attributes:
        shapes: Of `SHAPES`, of closed pieces.
        recipes: The recipes, in the order of the rows of the figures.
        starts: Agents on a grid over the box of each shape.
        seeds: Of clouds and trainings; the figures show the first.
    """

    shapes: list[str] = field(
        default_factory=lambda: ["concentric-circles", "separated-circles"]
    )
    recipes: list[str] = field(default_factory=lambda: ["paper", "robust"])
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        groups = list(product(self.shapes, self.recipes))
        trials = [
            OverviewTrial(*group, seed, self.starts) for group in groups for seed in self.seeds
        ]
        records = iter(bench.run(measure_overview, trials, "overview"))
        found = {group: [next(records) for _ in self.seeds] for group in groups}
        rows = {group: [record.row for record in own] for group, own in found.items()}
        histories = {
            group: [pd.read_parquet(record.folder / LOSSES) for record in own]
            for group, own in found.items()
        }
        totals = {
            group: [tangent_courses(history)["total"] for history in own]
            for group, own in histories.items()
        }
        return Outcome(
            exhibits=[
                *(self._figure(shape, found) for shape in self.shapes),
                Exhibit("overview_fields", FIELDS_CAPTION, fields_table(rows)),
                Exhibit("overview_losses", LOSSES_CAPTION, losses_table(histories)),
            ],
            claims=overview_claims(
                {recipe: _of_recipe(rows, recipe) for recipe in self.recipes},
                {recipe: _of_recipe(totals, recipe) for recipe in self.recipes},
            ),
        )

    def _figure(self, shape: str, found: Mapping[Group, Sequence[Record]]) -> Exhibit:
        rows = []
        for recipe in self.recipes:
            folder = found[shape, recipe][0].folder
            history = pd.read_parquet(folder / LOSSES)
            field, agents = load_field(folder / FIELD), np.load(folder / AGENTS)
            rows.append(OverviewRow(recipe, field, history, agents))
        caption = (
            f"{shape}, seed {self.seeds[0]}, a row a recipe: score, tangent, losses of the "
            "tangent network, and two agents, for each piece the one that starts farthest "
            "from it (dots: starts)."
        )
        return Exhibit(f"overview_{shape}", caption, overview_figure(rows))


def fields_table(rows: Mapping[Group, Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    """Returns one row a shape and recipe, over the seeds."""
    table = []
    for (shape, recipe), own in rows.items():
        columns = pd.DataFrame(own)
        table.append(
            {
                "shape": shape,
                "recipe": recipe,
                "reach": columns["reach"].mean(),
                **interval_columns("lap", columns["lap"], SHARE),
                **fraction_columns("fields followed", [followed(row) for row in own]),
                **interval_columns("RMS, U", columns["rms_u"]),
                **interval_columns("largest, U", columns["max_u"]),
                **interval_columns("least |m|", columns["speed_min"]),
                **interval_columns("largest |m|", columns["speed_max"]),
                **interval_columns("training, s CPU", columns["train_cpu_s"]),
            }
        )
    return pd.DataFrame(table)


def _of_recipe(values: Mapping[Group, Sequence[T]], recipe: str) -> list[T]:
    return [value for group, own in values.items() if group[1] == recipe for value in own]
