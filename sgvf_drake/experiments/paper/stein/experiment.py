"""Section II-B: Stein's identity, of the exact score, the learned ones and the squashed one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.experiments.figures.stein import ScoreSeries, stein_figure
from sgvf_drake.paper.intervals import interval_columns
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.stein.claims import stein_claims
from sgvf_drake.experiments.paper.stein.findings import SQUASHED_NAME, Finding, find
from sgvf_drake.experiments.paper.stein.trials import (
    CHUNK,
    EXACT,
    Moments,
    SteinTrial,
    measure_stein,
)
from sgvf_drake.experiments.workbench import Workbench

SAMPLING = "uniform"
# Waypoints ten times denser on one side: on an even shape, means vanish by symmetry alone.
LOPSIDED = ("circle", "uneven")

FIGURE_CAPTION = (
    "Left: waypoints, and the supports of the test fields. Middle: the residual of "
    "E[S f^T] = -E[grad f] over the number of draws; that of the exact score falls as one "
    "over the root, those of learned scores end at their error. Right: the residual with "
    "each test field beside what the identity says; means over the seeds."
)
SCORES_CAPTION = (
    "The residual of Stein's identity, root mean square over the test fields, and the means "
    "E[S] and E[S log p] that should be zero; all in per cent of the largest value that the "
    "Cauchy-Schwarz inequality allows. What the identity says is a small part of that; see "
    "the figure. A learned score is tested on the density that it learned, whose noise level "
    "the robust recipe sets by the spacing of the waypoints."
)
PROBES_CAPTION = (
    "The residual with each test field, in per cent as above, beside what the identity says "
    "and the standard error of the exact score; means over the seeds."
)


@dataclass
class SteinIdentity:
    """Puts scores to Stein's identity E[S f^T] = -E[grad f], by Monte Carlo.

    Attributes:
        cloud: Whose density and scores are tested, one of `clouds.PATHS`.
        recipes: Those that learn a score.
        draws: Samples of the density, for each seed; a multiple of 20,000.
        seeds: Of the training and the draws.
    """

    cloud: str = "concentric-circles"
    recipes: list[str] = field(default_factory=lambda: ["robust", "paper"])
    draws: int = 500_000
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show.

        Raises:
            ConfigurationError: The number of draws is not such a multiple.
        """
        if self.draws < CHUNK or self.draws % CHUNK:
            raise ConfigurationError(
                f"draws must be a positive multiple of {CHUNK}, not {self.draws}"
            )
        places = [(self.cloud, SAMPLING, score) for score in (EXACT, *self.recipes)]
        places.append((*LOPSIDED, EXACT))
        trials = [
            SteinTrial(*place, seed, self.draws) for place, seed in product(places, self.seeds)
        ]
        records = bench.run(measure_stein, trials, "Stein's identity")
        parts = [Moments.load(record.folder) for record in records]
        found: list[Finding] = []
        for number, (cloud, sampling, score) in enumerate(places):
            own = parts[number * len(self.seeds) : (number + 1) * len(self.seeds)]
            found += find(f"{cloud}, {sampling}", score, own)
        probes = records[0].row["probes"]
        even = [finding for finding in found if finding.density == found[0].density]
        drawn, _ = make_cloud(self.cloud, SAMPLING, self.seeds[0])
        figure = stein_figure(
            drawn.normalize(drawn.points),
            probes,
            found[0].signals.mean(axis=0),
            [
                ScoreSeries(finding.score, finding.curve, finding.residuals.mean(axis=0))
                for finding in even
                # Not to scale: the squashed score is shown rescaled alone.
                if finding.score != SQUASHED_NAME
            ],
        )
        return Outcome(
            exhibits=[
                Exhibit("stein", FIGURE_CAPTION, figure),
                Exhibit("stein_scores", SCORES_CAPTION, scores_table(found)),
                Exhibit("stein_test_fields", PROBES_CAPTION, probes_table(probes, even)),
            ],
            claims=stein_claims(found),
        )


def scores_table(found: Sequence[Finding]) -> pd.DataFrame:
    """Returns one row a score: residual, means, and the error of the score."""
    return pd.DataFrame(
        {
            "waypoints": finding.density,
            "score": finding.score,
            **interval_columns("residual, %", 100 * (finding.residuals**2).mean(axis=1) ** 0.5),
            "largest entry, std. errors": finding.z,
            **interval_columns("E[S], %", 100 * finding.means),
            **interval_columns("E[S log p], %", 100 * finding.logs),
            "error of the score, %": 100 * finding.score_errors.mean(),
        }
        for finding in found
    )


def probes_table(probes: Sequence[Mapping[str, Any]], found: Sequence[Finding]) -> pd.DataFrame:
    """Returns one row a test field: what the identity says, and the residuals."""
    exact = found[0]
    table = pd.DataFrame(
        {
            "test field": [probe["form"] for probe in probes],
            "radius, U": [probe["radius"] for probe in probes],
            "identity, %": 100 * exact.signals.mean(axis=0),
            "std. error, %": 100 * exact.errors.mean(axis=0),
        }
    )
    for finding in found:
        table[f"{finding.score}, %"] = 100 * finding.residuals.mean(axis=0)
    return table
