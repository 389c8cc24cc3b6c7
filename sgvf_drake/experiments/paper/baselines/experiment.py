"""Sections I and II-A: classical fields and SGVF on the same clouds, by the same protocol."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.baselines import Panel, baselines_figure
from sgvf_drake.paper.intervals import SHARE, interval, interval_columns
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.baselines.claims import HANDLED, baseline_claims
from sgvf_drake.experiments.paper.baselines.methods import CASES, LEARNED, METHODS
from sgvf_drake.experiments.paper.baselines.trials import (
    TRAJECTORIES,
    BaselineTrial,
    measure_baseline,
)
from sgvf_drake.experiments.workbench import Record, Workbench

# Of the figure, where they were run: enough to see what happens.
SHOWN_METHODS = ("implicit", "fourier", "smoothed", "paper", "robust")
SHOWN_CASES = ("ordered", "shuffled", "noisy", "branching", "pieces")
# Cases for the classical methods alone: the corners of SGVF are an experiment of their own.
CLASSICAL_CASES = ("corners",)

Cells = Mapping[tuple[str, str], Sequence[Record]]


@dataclass
class BaselineComparison:
    """Follows clouds with classical fields and with SGVF: the same starts, the same measures.

    Attributes:
        cases: The clouds, of `baseline_methods.CASES`.
        methods: The ways to a field, of `baseline_methods.METHODS`.
        starts: Number of starts, a grid over the box.
        seeds: Of noise, order and training.
    """

    cases: list[str] = field(default_factory=lambda: list(CASES))
    methods: list[str] = field(default_factory=lambda: list(METHODS))
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show.

        Raises:
            ConfigurationError: There is no such case or method, or none is given.
        """
        _check("case", self.cases, CASES)
        _check("method", self.methods, METHODS)
        _check("seed", self.seeds, self.seeds)
        cells = self._run(bench)
        rows = pd.DataFrame(
            {"case": case, "method": method, "seed": seed, **record.row}
            for (case, method), records in cells.items()
            for seed, record in zip(self.seeds, records, strict=False)
        )
        shares = {key: _means(records) for key, records in cells.items()}
        figure = baselines_figure(
            _panels(cells),
            {name: METHODS[name].label for name in SHOWN_METHODS if name in self.methods},
            {name: CASES[name].label for name in SHOWN_CASES if name in self.cases},
        )
        tables = [
            Exhibit(f"baselines_{case}", f"{CAPTIONS[case]} {_MEASURES}", _table(case, rows))
            for case in self.cases
        ]
        return Outcome(
            exhibits=[
                Exhibit("baselines", f"The same {self.starts} {_FIGURE_CAPTION}", figure),
                *tables,
            ],
            claims=baseline_claims(shares),
            logs={"baselines": rows},
        )

    def _run(self, bench: Workbench) -> Cells:
        """Returns the records by case and method, one a seed or, without chance, one in all."""
        trials = {
            (case, method): [self._trial(case, method, seed) for seed in self.seeds]
            for case in self.cases
            for method in self.methods
            if not (case in CLASSICAL_CASES and method in LEARNED)
        }
        different = list(dict.fromkeys(trial for cell in trials.values() for trial in cell))
        records = bench.run(measure_baseline, different, "baselines")
        by_trial = dict(zip(different, records, strict=True))
        return {
            key: [by_trial[trial] for trial in dict.fromkeys(cell)]
            for key, cell in trials.items()
        }

    def _trial(self, case: str, method: str, seed: int) -> BaselineTrial:
        """Returns the trial; what cannot differ is one trial, run once.

        What does not take the order of the waypoints for that of the path gets those of the
        shuffled case in the ordered one; and a formula without noise or order has no seed.
        """
        takes_order = METHODS[method].takes_order
        if case == "ordered" and not takes_order:
            case = "shuffled"
        by_chance = CASES[case].noise > 0 or (CASES[case].shuffled and takes_order)
        if method not in LEARNED and not by_chance:
            seed = self.seeds[0]
        return BaselineTrial(case, method, seed, self.starts)


def _check(what: str, names: Sequence, known: Sequence | Mapping) -> None:
    if not names:
        raise ConfigurationError(f"the comparison needs a {what}")
    for name in names:
        if name not in known:
            raise ConfigurationError(
                f"there is no {what} {name!r} (they are {', '.join(map(str, known))})"
            )


def _means(records: Sequence[Record]) -> tuple[float, float]:
    """Returns success and coverage, means over the seeds."""
    found = [(record.row["success"], record.row["coverage"]) for record in records]
    success, coverage = np.mean(found, axis=0)
    return float(success), float(coverage)


def _panels(cells: Cells) -> dict[tuple[str, str], Panel]:
    panels = {}
    for (case, method), records in cells.items():
        if method in SHOWN_METHODS and case in SHOWN_CASES:
            row = records[0].row
            title = f"{100 * row['success']:.0f} %"
            if row["success"] >= HANDLED > row["coverage"]:
                title += f" on {100 * row['coverage']:.0f} % of it"
            panels[method, case] = Panel.load(records[0].folder / TRAJECTORIES, title)
    return panels


def _table(case: str, rows: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for method, found in rows[rows["case"] == case].groupby("method", sort=False):
        lines.append(
            {
                "method": METHODS[str(method)].label,
                **interval_columns("success", found["success"], SHARE),
                "coverage": found["coverage"].mean(),
                **interval_columns("RMS, U", found["rms_u"].astype(float)),
                "max, U": found["max_u"].astype(float).max(),
                **interval_columns("effort, 1/U", found["effort"].astype(float)),
                "build, s": interval(found["build_s"])[0],
                "point, µs": found["evaluation_us"].min(),
            }
        )
    return pd.DataFrame(lines)


_FIGURE_CAPTION = (
    "starts on every cloud, first seed: blue where an agent laps the path (on the branching "
    "one: stays on it, and stops only at a tip), red where it does not. Above each panel the "
    "share of those that do, and of how many of the waypoints if that is not all."
)
CAPTIONS = {
    "ordered": "Evenly spaced waypoints on a smooth curve, in their order. What asks for no "
    "order has the same trials here as shuffled.",
    "shuffled": "The same waypoints in random order.",
    "noisy": "The same with noise of 0.05 U, in random order.",
    "branching": "Three bent arms from one middle, arm by arm, from the middle out.",
    "pieces": "Two concentric circles, one after the other.",
    "corners": "A square, in order; SGVF at corners has an experiment of its own.",
}
_MEASURES = (
    "Success: share of the starts; coverage: share of the waypoints that those pass within "
    "0.3 U; errors and effort (RMS curvature of their way, the acceleration at unit speed) "
    "are theirs too. Build: CPU time to the first value; point: time of one value, without "
    "compiling. Means over the seeds with 95 % intervals; max is of all."
)
