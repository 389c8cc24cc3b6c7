"""Sections I and II-A: classical fields and SGVF on the same clouds, by the same protocol.

A method handles a case if 95 % of the starts succeed and 95 % of the waypoints are passed,
on average over the seeds; in part, if half of both; it is broken if 5 % of the starts succeed,
or fewer.

A start succeeds where its agent laps a closed path; where the path branches there is no lap,
and it has to stay on the path and to stop nowhere but at a tip; where the path crosses itself
it has to go straight over.  All fields are measured so, against the true path, also those
that know their heading.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
import time
import timeit
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.follow import FollowResult, PathField, follow, follow_network
from sgvf_drake.experiments.intervals import POSITIVE, SHARE
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import DirectedField, Field, ParametricField
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.metrics import default_duration
from sgvf_drake.paper.claims import Claim, Count, Judged, Rows, Verdict
from sgvf_drake.paper.experiment import (
    FOLDER,
    Column,
    Exhibit,
    Experiment,
    SeedsTable,
    check_names,
    run_trials,
)
from sgvf_drake.paper.methods import CASES, DIRECTED, LEARNED, METHODS, make_case
from sgvf_drake.paper.ways import (
    Ways,
    coverage,
    crossing_ways,
    effort,
    errors,
    find_ways,
)
from sgvf_drake.paths import ReferencePath

HANDLED, HALF, BROKEN = 0.95, 0.5, 0.05
# One point, so often in a row, and the best of so many rows.
EVALUATIONS, ROWS = 20, 7
TRAJECTORIES = "trajectories.npz"
# Every so many samples are kept for the figure: 0.2 U at full speed.
KEPT = 4
# U; what is shown of the plane: the box of the starts, and a margin.
SHOWN = 6.0
# Of the figure, where they were run: enough to see what happens.
SHOWN_METHODS = ("implicit", "fourier", "smoothed", "paper", "robust")
SHOWN_CASES = ("ordered", "shuffled", "noisy", "branching", "pieces")
SHOWN_ON_NETWORKS = ("smoothed", "guided", "robust", "directed")
# Paths that cross or branch, for directed fields; others have one direction everywhere.
NETWORK_CASES = ("branching", "eight", "course", "demonstrations", "streets")
# Of them the paper claims the branching ones, beside those that do not cross or branch.
CLAIMED_CASES = (*SHOWN_CASES, "streets")
# What is left out: SGVF at corners, which is an experiment of its own; the implicit curve in
# space; and, for time, two recipes of the position alone where the paper claims nothing: a
# field without memory has one direction at a crossing, whatever its recipe.
LEFT_OUT = {
    **dict.fromkeys(("ordered", "shuffled", "noisy", "pieces"), DIRECTED),
    "corners": LEARNED,
    **dict.fromkeys(("eight", "course", "demonstrations"), ("paper", "exact")),
    "streets": ("exact",),
    "space": ("implicit", "paper", "exact", *DIRECTED),
}
INTERPOLATIONS = ("fourier", "lagrange", "parametric")
CLASSICAL = tuple(name for name in METHODS if name not in LEARNED)
STATELESS = tuple(name for name in LEARNED if name not in DIRECTED)
TAKING_ORDER = tuple(name for name in METHODS if METHODS[name].takes_order)

_FIGURE_CAPTION = (
    "starts on every cloud, first seed: blue where an agent laps the path (where it branches: "
    "stays on it, and stops only at a tip; where it crosses: goes straight over), red where it "
    "does not. Above each panel the share of those that do, and of how many of the waypoints "
    "if that is not all."
)
CAPTIONS = {
    "ordered": "Evenly spaced waypoints on a smooth curve, in their order. What asks for no "
    "order has the same trials here as shuffled.",
    "shuffled": "The same waypoints in random order.",
    "noisy": "The same with noise of 0.05 U, in random order.",
    "branching": "Three bent arms from one middle, arm by arm, from the middle out. Sorting "
    "makes a curve of each arm, which agents leave the middle by: none passes the waypoints "
    "beside it.",
    "pieces": "Two concentric circles, one after the other.",
    "corners": "A square, in order; SGVF at corners has an experiment of its own.",
    "eight": "A figure-eight, in order; it is lapped straight over its crossing.",
    "course": "A race course that crosses itself once, in random order, with noise of 0.05 U.",
    "demonstrations": "Five demonstrations of one stroke that crosses itself, one after the "
    "other, each shifted by 0.1 U: an agent has to follow it to an end, straight over the "
    "crossing. The parametric field is that of a closed curve, and never rests.",
    "streets": "Seven streets, one after the other, with five junctions, a crossing and a dead "
    "end: there is no lap; an agent has to stay on them, and stops only at the dead end.",
    "space": "A knot in space, in random order; an implicit curve is planar.",
}
Cells = Sequence[tuple[str, str]]
"""Cases, each with a method that is run on it."""

_MEASURES = (
    "Success: share of the starts; coverage: share of the waypoints that those pass within "
    "0.3 U; errors and effort (RMS curvature of their way, the acceleration at unit speed) "
    "are theirs too. Build: CPU time to the first value; point: time of one value, without "
    "compiling. Means over the seeds with 95 % intervals; max is of all."
)
_COLUMNS: Mapping[str, Column] = {
    "success": ("success", SHARE),
    "coverage": ("coverage", pd.Series.mean),
    "RMS, U": ("rms_u", POSITIVE),
    "max, U": ("max_u", pd.Series.max),
    "effort, 1/U": ("effort", POSITIVE),
    "build, s": ("build_s", pd.Series.mean),
    "point, µs": ("evaluation_us", pd.Series.min),
}


@dataclass(frozen=True)
class BaselineTrial:
    """One of `METHODS` on one of `CASES`; the rest is as in `BaselineComparison`."""

    case: str
    method: str
    seed: int
    starts: int


def measure_baseline(trial: BaselineTrial, folder: Path) -> Row:
    """Builds a field, follows it and measures it; leaves its trajectories.

    Returns:
        success, coverage, rms_u, max_u, effort (1/U), build_s (CPU, with the first
        evaluation), evaluation_us (one point); errors and effort are those of the agents
        that succeed, None without any.
    """
    cloud, reference = make_case(CASES[trial.case], trial.seed)
    if trial.method in LEARNED:
        import sgvf_drake.learning  # noqa: F401 (torch, before the time is taken)
    begin = time.process_time()
    field = METHODS[trial.method].build(cloud, trial.seed)
    point = cloud.points[0]
    motion: Field = field.with_memory() if isinstance(field, DirectedField) else field
    state = point
    if isinstance(field, ParametricField):
        state = field.lift(point[None])[0]
    elif isinstance(field, DirectedField):
        state = np.concatenate([point, np.eye(cloud.dim)[0]])
    motion(state)
    build_s = time.process_time() - begin
    run, ways = follow_case(field, reference, trial, folder)
    seconds = timeit.repeat(lambda: motion(state), number=EVALUATIONS, repeat=ROWS)
    return {
        "success": float(ways.good.mean()),
        "coverage": coverage(run, ways, cloud),
        **errors(run, ways, cloud.unit_length),
        "effort": effort(run, ways, cloud.unit_length),
        "build_s": build_s,
        "evaluation_us": 1e6 * min(seconds) / EVALUATIONS,
    }


def follow_case(
    field: PathField, reference: ReferencePath, trial: BaselineTrial, folder: Path
) -> tuple[FollowResult, Ways]:
    """Follows the field of a trial; leaves what `draw_trajectories` draws.

    That is waypoints and agents in U, and who succeeded.  A directed field is followed by
    agents that remember their heading, at first one by chance; all are measured against the
    true path.
    """
    cloud, method = field.cloud, trial.method
    patience = RECIPES[method].patience if method in RECIPES else 1.0
    duration = patience * default_duration(reference, cloud.unit_length)
    run: FollowResult
    if isinstance(field, DirectedField):
        run = follow_network(field, trial.starts, duration, seed=trial.seed)
        places = run.positions.reshape(-1, cloud.dim)
        distance = reference.project(places).distance
        run = replace(run, errors=distance.reshape(run.errors.shape))
    else:
        run = follow(field, reference, trial.starts, duration)
    if CASES[trial.case].crosses:
        ways = crossing_ways(run, reference, field)
    else:
        ways = find_ways(run, reference, cloud.unit_length, patience)
    np.savez_compressed(
        folder / TRAJECTORIES,
        points=cloud.normalize(cloud.points),
        positions=cloud.normalize(run.positions[::KEPT]).astype(np.float32),
        good=ways.good,
    )
    return run, ways


def draw_trajectories(axes: Axes, folder: Path) -> Count:
    """Draws what `follow_case` left; returns how many agents succeeded."""
    with np.load(folder / TRAJECTORIES) as stored:
        plotting.plot_trajectories(axes, stored["positions"], stored["good"])
        plotting.plot_waypoints(axes, stored["points"])
        return Count.of(stored["good"])


@dataclass
class BaselineComparison(Experiment):
    """Follows clouds with classical fields and with SGVF: the same starts, the same measures.

    Attributes:
        cases: The clouds, of `methods.CASES`.
        methods: The ways to a field, of `methods.METHODS`.
        starts: Number of starts, a grid over the box.
        seeds: Seeds of noise, order and training.
    """

    cases: list[str] = field(default_factory=lambda: list(CASES))
    methods: list[str] = field(default_factory=lambda: list(METHODS))
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def measure(self, bench: Workbench) -> Rows:
        """Follows every method on every case.

        Returns:
            `cells`: a row a case, method and seed, or without chance one a case and method.

        Raises:
            ConfigurationError: There is no such case or method, or none is given.
        """
        for what, names, known in (
            ("case", self.cases, CASES),
            ("method", self.methods, METHODS),
        ):
            check_names(what, names, known)
            if not names:
                raise ConfigurationError(f"the comparison needs a {what}")
        cells = [
            (case, trial)
            for case, method in self._cells()
            # Without chance, the trials of all seeds are the same one.
            for trial in dict.fromkeys(self._trial(case, method, seed) for seed in self.seeds)
        ]
        found = run_trials(bench, measure_baseline, [trial for _, trial in cells], "baselines")
        return {"cells": found.assign(case=[case for case, _ in cells])}

    def _trial(self, case: str, method: str, seed: int) -> BaselineTrial:
        """Returns the trial; what cannot differ is one trial, run once.

        What does not take the order of the waypoints for that of the path gets those of the
        shuffled case in the ordered one; and a formula without noise or order has no seed.
        """
        takes_order = METHODS[method].takes_order
        if case == "ordered" and not takes_order:
            case = "shuffled"
        own = CASES[case]
        by_chance = own.noise > 0 or own.passes or (own.shuffled and takes_order)
        if method not in LEARNED and not by_chance:
            seed = self.seeds[0]
        return BaselineTrial(case, method, seed, self.starts)

    def _cells(self) -> list[tuple[str, str]]:
        """Returns the cases and the methods that are run on them."""
        return [
            (case, method)
            for case in self.cases
            for method in self.methods
            if method not in LEFT_OUT.get(case, ())
        ]

    def claims(self) -> list[Claim]:
        """Returns the claims whose cases and methods are run."""
        run, found = self._cells(), []
        for key, source, statement, cases, methods, measure in _CLAIMS:
            cells = [(case, name) for case in cases for name in methods if (case, name) in run]
            if measure is _advantage:
                cells = [cell for cell in cells if _sides(cell[0], cells) == {True, False}]
            if cells:
                measured = partial(measure, cells=cells)
                of_paper = set(methods).isdisjoint(DIRECTED)
                found.append(Claim(key, source, statement, measured, of_paper))
        return found

    def tables(self, rows: Rows) -> list[Exhibit]:
        """Returns a table a case."""
        labels = {name: method.label for name, method in METHODS.items()}
        cells = rows["cells"].assign(method=rows["cells"]["method"].map(labels))
        return [
            SeedsTable(f"baselines_{case}", f"{CAPTIONS[case]} {_MEASURES}", _COLUMNS).of(
                cells[cells["case"] == case].astype({"max_u": float}), ("method",)
            )
            for case in self.cases
        ]

    def figures(self, rows: Rows) -> list[Exhibit]:
        """Returns grids of panels: methods from top to bottom, cases from left to right."""
        caption = f"The same {self.starts} {_FIGURE_CAPTION}"
        grids = (
            ("baselines", SHOWN_METHODS, SHOWN_CASES),
            ("baselines_networks", SHOWN_ON_NETWORKS, NETWORK_CASES),
        )
        return [
            Exhibit(name, caption, self._grid(rows, shown, cases))
            for name, shown_methods, shown_cases in grids
            if (shown := [one for one in shown_methods if one in self.methods])
            and (cases := [one for one in shown_cases if one in self.cases])
        ]

    def _grid(self, rows: Rows, methods: Sequence[str], cases: Sequence[str]) -> Figure:
        height, width = len(methods), len(cases)
        figure, flat = plotting.new_figure(height, width, 2.4 * width, 2.5 * height + 0.4)
        firsts = rows["cells"].groupby(["case", "method"], sort=False).first()
        for axes, (method, case) in zip(flat, product(methods, cases), strict=True):
            title = ""
            if (case, method) in firsts.index:
                row: Any = firsts.loc[(case, method)]
                draw_trajectories(axes, row[FOLDER])
                title = _followed(row["success"], row["coverage"])
            if method == methods[0]:
                title = f"{CASES[case].label}\n{title}"
            axes.set_title(title, fontsize="medium")
            axes.set(xlim=(-SHOWN, SHOWN), ylim=(-SHOWN, SHOWN), aspect="equal")
            axes.set(xlabel="x [U]", ylabel=f"{METHODS[method].label}\ny [U]")
            axes.label_outer()
        return figure

    def logs(self, rows: Rows) -> Mapping[str, pd.DataFrame]:
        """Returns all rows."""
        return {"baselines": rows["cells"].drop(columns=FOLDER, errors="ignore")}


def _followed(success: float, covered: float) -> str:
    part = f"{100 * success:.0f} %"
    return f"{part} on {100 * covered:.3g} % of it" if success >= HANDLED > covered else part


def _sides(case: str, cells: Cells) -> set[bool]:
    """Returns whether learned methods are run on a case, and whether others are."""
    return {method in LEARNED for own, method in cells if own == case}


def _shares(rows: Rows, cells: Cells) -> pd.DataFrame:
    """Returns success and coverage, means over the seeds, and the `least` of both."""
    means = rows["cells"].groupby(["case", "method"])[["success", "coverage"]].mean()
    return means.assign(least=means.min(axis=1)).loc[[*cells]]


def _told(shares: pd.DataFrame) -> dict[str, str]:
    """Success of methods on each case, and coverage where that is what is missing."""
    told: dict[str, list[str]] = {}
    columns = shares.index, shares["success"], shares["coverage"]
    for (case, method), success, covered in zip(*columns, strict=True):
        name = f"starts that succeed, {CASES[case].label}"
        text = f"{METHODS[method].label} {_followed(success, covered)}"
        told.setdefault(name, []).append(text)
    return {name: ", ".join(texts) for name, texts in told.items()}


def _handled(rows: Rows, cells: Cells) -> Judged:
    shares = _shares(rows, cells)
    handled = Count.of(shares["least"] >= HANDLED)
    return {"handled": handled, **_told(shares)}, Verdict.every(handled)


def _own_handled(rows: Rows, cells: Cells) -> Judged:
    """As `_handled` of the paper's recipe, with the other recipes told beside it."""
    run = set(rows["cells"].groupby(["case", "method"]).groups)
    everyone = [(case, name) for case, _ in cells for name in LEARNED if (case, name) in run]
    figures, verdict = _handled(rows, cells)
    return {**figures, **_told(_shares(rows, everyone))}, verdict


def _broken(rows: Rows, cells: Cells) -> Judged:
    shares = _shares(rows, cells)
    broken = Count.of(shares["success"] <= BROKEN)
    return {"broken": broken, **_told(shares)}, Verdict.every(broken)


def _failures(rows: Rows, cells: Cells) -> Judged:
    """Holds if no method handles any of the cases; not if one handles all."""
    shares = _shares(rows, cells)
    handled = (shares["least"] >= HANDLED).groupby("method")
    some, one_for_all = Count.of(handled.any()), Count.of(handled.all())
    return {
        "methods that handle a case": some,
        "methods that handle all cases": one_for_all,
        **_told(shares),
    }, Verdict.when(some.good == 0, one_for_all.good == 0)


def _advantage(rows: Rows, cells: Cells) -> Judged:
    shares = _shares(rows, cells)
    own = shares.index.get_level_values("method").isin(LEARNED)
    best, others = (side["least"].groupby("case").max() for side in (shares[own], shares[~own]))
    left = best[others < HANDLED]
    handled, partly = Count.of(left >= HANDLED), Count.of(left >= HALF)
    return {
        "cases that no classical method handles, sorting first included": Count(
            len(left), len(best)
        ),
        "of these handled by SGVF": handled,
        "handled in part": partly,
        **_told(shares[own & shares.index.get_level_values("case").isin(left.index)]),
    }, Verdict.when(0 < handled.good == handled.all, partly.good > 0)


# Key, source, statement, cases, methods and measure.
_CLAIMS = (
    (
        "baselines-ordered",
        "Section I, Fig. 1 (left)",
        "Ordered waypoints are interpolated, by Lagrange's or Fourier's method, to a curve "
        "that a classical guiding vector field follows.",
        *(["ordered"], INTERPOLATIONS, _handled),
    ),
    (
        "baselines-shuffled",
        "Section I, Fig. 1 (middle)",
        "Shuffled waypoints break what takes their order for that of the path.",
        *(["shuffled"], TAKING_ORDER, _broken),
    ),
    (
        "baselines-unordered",
        "Abstract, Section I",
        "Classical methods fail when the waypoints are unordered.",
        *(["shuffled", "noisy"], CLASSICAL, _failures),
    ),
    (
        "baselines-branching",
        "Abstract, Section I, Fig. 1 (right)",
        "Classical methods fail when the path branches.",
        *(["branching", "streets"], CLASSICAL, _failures),
    ),
    (
        "baselines-pieces",
        "Abstract, Section V-A",
        "Classical methods fail when the path is several curves.",
        *(["pieces"], CLASSICAL, _failures),
    ),
    (
        "baselines-corners",
        "Section I",
        "A path with corners, as a square, cannot have a classical guiding vector field.",
        *(["corners"], CLASSICAL, _failures),
    ),
    (
        "baselines-sgvf",
        "Abstract, Section I (contribution 1)",
        "SGVF follows unordered, noisy and branching waypoints in one framework; judged by "
        "the paper's own recipe.",
        *(CLAIMED_CASES, ["paper"], _own_handled),
    ),
    (
        "baselines-advantage",
        "Abstract, Section VII",
        "SGVF follows paths reliably on which classical guiding vector fields fail.",
        *(list(CASES), [*CLASSICAL, *STATELESS], _advantage),
    ),
    (
        "baselines-directed",
        "directed fields",
        "A field m(x, g) that knows its heading follows paths that cross or branch.",
        *(NETWORK_CASES, DIRECTED, _handled),
    ),
    (
        "baselines-directed-advantage",
        "directed fields",
        "A field that knows its heading follows paths that cross or branch on which classical "
        "guiding vector fields fail.",
        *(NETWORK_CASES, [*CLASSICAL, *DIRECTED], _advantage),
    ),
)
