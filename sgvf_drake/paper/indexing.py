"""Fig. 1: ordered, shuffled and branching waypoints, for classical methods and for SGVF."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.intervals import POSITIVE, SHARE
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import (
    FloatArray,
    FourierCurve,
    GaussianMixture,
    GuidingField,
    LagrangeCurve,
    load_guiding_field,
)
from sgvf_drake.fields.classical import Curve
from sgvf_drake.metrics import REACH_DISTANCE, SETTLE_DISTANCE, grid_starts
from sgvf_drake.paper.baselines import (
    BaselineTrial,
    draw_trajectories,
    follow_case,
    measure_baseline,
)
from sgvf_drake.paper.claims import Claim, Count, Judged, Rows, Share, Span, Verdict
from sgvf_drake.paper.experiment import FOLDER, Exhibit, Experiment, SeedsTable, run_trials
from sgvf_drake.paper.methods import CASES, make_case
from sgvf_drake.paper.training import trained
from sgvf_drake.paper.ways import coverage
from sgvf_drake.paths import ReferencePath

FIELD = "field.safetensors"
GIVEN = ("ordered", "shuffled", "branching")
CURVES: dict[str, type[Curve]] = {"fourier": FourierCurve, "lagrange": LagrangeCurve}
LABELS = {"fourier": "Fourier", "lagrange": "Lagrange"}
COLORS = {"fourier": plotting.BLUE, "lagrange": plotting.ORANGE}
# The curve whose field is drawn with its agents; the other is off the paper.
DRAWN = "fourier"
# Points of a curve at which its length and its distance from the path are taken; between two
# waypoints of 200 there are a hundred.
SAMPLES = 20_001
# Points of the box at which fields are compared, and half of its size, U.
GRID, HALF_SIZE = 2_500, 5.0

SECTION = "Section I, Fig. 1"
# A curve has the shape of the path where it stays this near to it (U), and is no longer or
# shorter by more than this part of it.
NEAR, LENGTH_TOLERANCE = REACH_DISTANCE, 0.05
# It is broken where it is farther from the path than an agent that follows it (U), and longer
# by more than this factor.
FAR, LONGER = SETTLE_DISTANCE, 1.5
# Fields trained on two orders agree where they differ by at most this factor more than those
# of two seeds, which draw other numbers in the training.
AGREEMENT = 1.5
# Agents that succeed, and waypoints that they pass, where a path is followed; and in part.
MOST, HALF = 0.95, 0.5
TABLES = (
    SeedsTable(
        "indexing_curves",
        "Length of the interpolated curve over that of the true path, and its largest distance "
        "from it; shuffled over several orders. Polynomials through many equally spaced "
        "waypoints swing beyond all bounds in whatever order.",
        {
            "length over true": ("length_ratio", POSITIVE),
            "farthest from path, U": ("farthest_u", POSITIVE),
        },
    ),
    SeedsTable(
        "indexing_agents",
        "Agents from a grid over the box, 200 waypoints; over the seeds. On the closed path an "
        "agent succeeds when it laps it, on the arms when it stays near them and stops nowhere "
        "but at a tip; coverage is the share of waypoints that those pass.",
        {"success": ("success", SHARE), "coverage": ("coverage", SHARE)},
    ),
    SeedsTable(
        "indexing_order",
        "By how much fields differ that were trained on two orders of the same waypoints with "
        "the same seed, beside those of two seeds on ordered waypoints (root mean square of "
        "the difference of m, where |m| = 1). The exact score does not depend on the order at "
        "all.",
        {name: (name, POSITIVE) for name in ("m, waypoints", "m, box", "exact score, box")},
    ),
)


@dataclass(frozen=True)
class CurveTrial:
    """One of `CURVES` through every so many-th waypoint of a case, one of `GIVEN`."""

    case: str
    curve: str
    thinning: int
    seed: int


def measure_curve(trial: CurveTrial, folder: Path) -> Row:
    """Measures a curve against the path that its waypoints come from; leaves nothing.

    Returns:
        waypoints; length_ratio, the length of the curve over that of the path; farthest_u,
        the largest distance of the curve from the path, U.
    """
    cloud, path = make_waypoints(trial)
    x = curve_points(trial.curve, cloud)
    return {
        "waypoints": cloud.num_points,
        "length_ratio": float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())
        / float(path.lengths.sum()),
        "farthest_u": float(path.project(x).distance.max()) / cloud.unit_length,
    }


def measure_learned(trial: BaselineTrial, folder: Path) -> Row:
    """Trains a field by a recipe and follows it; leaves it, and its trajectories.

    Returns:
        success and coverage, the share of agents that succeed and of waypoints they pass.
    """
    cloud, path = make_case(CASES[trial.case], trial.seed)
    # One attempt: at a fork, the self-check finds a fault in whatever was trained.
    field = trained(cloud, trial.method, trial.seed, max_restarts=0).guiding_field
    field.save(folder / FIELD)
    run, ways = follow_case(field, path, trial, folder)
    return {"success": float(ways.good.mean()), "coverage": coverage(run, ways, cloud)}


def make_waypoints(trial: CurveTrial) -> tuple[PointCloud, ReferencePath]:
    """Returns the waypoints of a trial in their order, and the path.

    Shuffled waypoints are the ordered ones in another order.
    """
    shuffled = trial.case == "shuffled"
    cloud, path = make_case(CASES["ordered" if shuffled else trial.case], trial.seed)
    points = cloud.points[:: trial.thinning]
    if shuffled:
        points = np.random.default_rng([trial.seed, 3]).permutation(points)
    return PointCloud(points), path


def curve_points(curve: str, cloud: PointCloud) -> FloatArray:
    """Returns points (n, 2) of the closed curve through all waypoints, in their unit."""
    through = CURVES[curve].through(cloud)
    w = np.linspace(0, through.length, SAMPLES)
    return cloud.denormalize(through.derivatives(w, 0)[0])


@dataclass
class Indexing(Experiment):
    """Puts ordered, shuffled and branching waypoints to interpolation and to SGVF.

    Attributes:
        recipe: The recipe of the learned fields.
        thinning: Curves go through every so many-th waypoint of 200; those of the first one
            are drawn.
        starts: Agents on a grid over the box.
        seeds: Seeds of the orders and the trainings.
    """

    recipe: str = "robust"
    thinning: list[int] = field(default_factory=lambda: [8, 1])
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def measure(self, bench: Workbench) -> Rows:
        """Runs curves, classical fields and learned fields.

        Returns:
            `curves`: a row a case, curve, thinning and seed; `agents`: a row a case, field
            and seed; `changes`: by how much two learned fields differ, see `field_changes`.
        """
        # Only shuffling depends on the seed.
        seeds = {case: self.seeds if case == "shuffled" else self.seeds[:1] for case in GIVEN}
        curves = [
            CurveTrial(case, curve, thinning, seed)
            for case, curve, thinning in product(GIVEN, CURVES, self.thinning)
            for seed in seeds[case]
        ]
        classical = [
            BaselineTrial(case, curve, seed, self.starts)
            for case, curve in product(GIVEN, CURVES)
            for seed in seeds[case]
        ]
        # One seed more on the ordered waypoints, only to compare its field with.
        further = max(self.seeds) + 1
        recipes = [
            BaselineTrial(case, self.recipe, seed, self.starts)
            for case in GIVEN
            for seed in (*self.seeds, *([further] if case == "ordered" else []))
        ]
        learned = run_trials(bench, measure_learned, recipes, "indexing, learned fields")
        fields = {
            case: [load_guiding_field(folder / FIELD) for folder in own[FOLDER]]
            for case, own in learned.groupby("case")
        }
        followed = run_trials(bench, measure_baseline, classical, "indexing, classical fields")
        agents = pd.concat([followed, learned[learned["seed"] != further]], ignore_index=True)
        return {
            "curves": run_trials(bench, measure_curve, curves, "indexing, curves"),
            "agents": agents.rename(columns={"method": "field"}),
            "changes": field_changes(fields["ordered"], fields["shuffled"]),
        }

    def claims(self) -> list[Claim]:
        """Returns the claims of Fig. 1, and those of the abstract on branches."""
        of_paper = self.recipe == "paper"
        return [
            Claim(
                "indexing-ordered",
                SECTION,
                "Orderly indexing preserves the shape of the waypoints.",
                partial(_curves, case="ordered", judged=SHAPED),
            ),
            Claim(
                "indexing-shuffled",
                SECTION,
                "Shuffled waypoints break the interpolation.",
                partial(_curves, case="shuffled", judged=BROKEN),
            ),
            Claim(
                "indexing-branching",
                SECTION,
                "Branching waypoints cannot be sequentially indexed: an order arm by arm, the "
                "best there is, breaks the interpolation.",
                partial(_curves, case="branching", judged=BROKEN),
            ),
            Claim(
                "indexing-free",
                SECTION,
                f"SGVF needs no order of the waypoints (recipe {self.recipe}).",
                partial(_freedom, recipe=self.recipe),
                of_paper,
            ),
            Claim(
                "indexing-branches",
                "Abstract, Section I",
                f"SGVF guides along branching waypoints (recipe {self.recipe}); a field "
                "without memory has one direction at the fork.",
                partial(_branches, recipe=self.recipe),
                of_paper,
            ),
        ]

    def tables(self, rows: Rows) -> list[Exhibit]:
        """Returns the tables of curves, of agents, and of the changes of fields."""
        agents = rows["agents"].assign(field=rows["agents"]["field"].map(_label))
        curves, followed, order = TABLES
        return [
            curves.of(
                rows["curves"].replace({"curve": LABELS}), ("case", "curve", "waypoints")
            ),
            followed.of(agents, ("case", "field")),
            order.of(rows["changes"], ("change",)),
        ]

    def figures(self, rows: Rows) -> list[Exhibit]:
        """Returns a column a case: the curves through few waypoints, then agents in fields."""
        shown = (DRAWN, self.recipe)
        height, width = 1 + len(shown), len(GIVEN)
        figure, axes = plotting.new_figure(height, width, 4 * width, 4 * height)
        firsts: Any = rows["agents"].groupby(["case", "field"]).first()
        for column, case in enumerate(GIVEN):
            cloud, _ = make_waypoints(CurveTrial(case, DRAWN, self.thinning[0], self.seeds[0]))
            for curve, color in COLORS.items():
                x = cloud.normalize(curve_points(curve, cloud))
                axes[column].plot(*x.T, color=color, linewidth=1.0, label=LABELS[curve])
            points = cloud.normalize(cloud.points)
            axes[column].plot(*points.T, "o", color="black", markersize=3.5)
            _frame(axes[column], f"{case}, {cloud.num_points} waypoints")
            for row, name in enumerate(shown, start=1):
                here = axes[row * width + column]
                good = draw_trajectories(here, firsts.loc[(case, name), FOLDER])
                suffix = " field" if name in LABELS else ""
                _frame(here, f"{case}, {_label(name)}{suffix}: {good} agents")
        axes[0].legend(loc="upper left", fontsize="small")
        caption = (
            "Top: curves through waypoints in the order in which they are given, on a smooth "
            "closed path, the same shuffled, and three arms given one after the other. Below: "
            "agents from a grid in the classical field of the Fourier curve through all "
            "waypoints, and in the field learned from them; red ones fail."
        )
        return [Exhibit("indexing", caption, figure)]


def field_changes(
    ordered: Sequence[GuidingField], shuffled: Sequence[GuidingField]
) -> pd.DataFrame:
    """Returns by how much fields differ, root mean square, a row a pair of fields.

    Args:
        ordered: Fields of ordered waypoints, with one seed after the other.
        shuffled: Fields of the same waypoints shuffled, with the same seeds but the last.

    Returns:
        Columns `change` ("another order" or "another seed") and the differences of m at the
        waypoints and over the box, and of sigma times the exact score over the box.
    """
    pairs = [("another order", *pair) for pair in zip(ordered[:-1], shuffled, strict=True)]
    pairs += [("another seed", *pair) for pair in pairwise(ordered)]
    return pd.DataFrame({"change": what, **_change(a, b)} for what, a, b in pairs)


def _change(a: GuidingField, b: GuidingField) -> Row:
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


SHAPED, BROKEN = "curves with the shape of the path", "broken curves"


def _curves(rows: Rows, case: str, judged: str) -> Judged:
    """Returns which curves have the shape of their path and which have lost it.

    One of these two counts is `judged`.
    """
    curves = rows["curves"]
    own = curves[curves["case"] == case]
    far, ratio = own["farthest_u"], own["length_ratio"]
    figures: dict[str, Any] = {
        SHAPED: Count.of((far <= NEAR) & ((ratio - 1).abs() <= LENGTH_TOLERANCE)),
        BROKEN: Count.of((far > FAR) & (ratio > LONGER)),
    }
    for (curve, waypoints), one in own.groupby(["curve", "waypoints"], sort=False):
        name = f"{LABELS[str(curve)]} through {waypoints}"
        figures[f"{name}, times the true length"] = Span.of(one["length_ratio"])
        figures[f"{name}, largest distance, U"] = Span.of(one["farthest_u"])
    agents = rows["agents"]
    for followed, one in agents[agents["case"] == case].groupby("field", sort=False):
        figures[f"agents that succeed, {_label(str(followed))}"] = Share(one["success"].mean())
    return figures, Verdict.every(figures[judged])


def _freedom(rows: Rows, recipe: str) -> Judged:
    changes = rows["changes"].groupby("change")["m, box"].mean()
    order, seed = changes["another order"], changes["another seed"]
    agents = rows["agents"]
    own = agents[(agents["case"] == "shuffled") & (agents["field"] == recipe)]
    success = own["success"].min()
    no_order, followed = Count.of([order <= AGREEMENT * seed]), Count.of([success >= MOST])
    return {
        "order matters no more than the seed": no_order,
        "RMS change of m over the box by another order": float(order),
        "by another seed": float(seed),
        "shuffled waypoints are followed": followed,
        "agents that succeed on them, least of the seeds": Share(success),
    }, Verdict.every(no_order, followed)


def _branches(rows: Rows, recipe: str) -> Judged:
    agents = rows["agents"]
    own = agents[(agents["case"] == "branching") & (agents["field"] == recipe)]
    success, covered = Share(own["success"].mean()), Share(own["coverage"].mean())
    least = min(success, covered)
    return {
        "agents that follow the branches": success,
        "waypoints that they pass": covered,
    }, Verdict.when(least >= MOST, least >= HALF)


def _label(field: str) -> str:
    """Returns what a field is called: by its curve, or by its recipe."""
    return LABELS.get(field, f"SGVF, {field}")


def _frame(axes: Axes, title: str) -> None:
    plotting.plane_axes(axes, "U", title)
    axes.set(xlim=(-HALF_SIZE, HALF_SIZE), ylim=(-HALF_SIZE, HALF_SIZE))
