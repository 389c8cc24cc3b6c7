"""Fig. 2: score, tangent, losses and two agents, on the two shapes of the paper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.experiments.follow import FollowResult, follow
from sgvf_drake.experiments.intervals import (
    POSITIVE,
    SHARE,
    fraction_columns,
    fraction_interval,
)
from sgvf_drake.experiments.quality.measures import following, measure_score
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import ScoreField, TangentField, load_guiding_field
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.metrics import default_duration
from sgvf_drake.paper.claims import (
    Claim,
    Claims,
    Count,
    Judged,
    Mean,
    Rows,
    Share,
    Span,
    Verdict,
)
from sgvf_drake.paper.experiment import FOLDER, Exhibit, Experiment, SeedsTable, run_trials
from sgvf_drake.paper.training import trained
from sgvf_drake.paths import ReferencePath, make_shape

FIELD, LOSSES, AGENTS = "field.safetensors", "losses.parquet", "agents.npy"
# Every so many samples of a trajectory are kept for the picture.
THINNING = 2
AGENT_COLORS = (plotting.BLUE, plotting.RED)

# The score shows the density of the waypoints where it points the way of the exact one: to
# 25 degrees on average, and to the same side in 95 of 100 places near the path.
MEAN_COSINE, LOW_COSINE = 0.9, 0.0
# Parts into which a training is cut, each of which has one mean.
PARTS = 10
# The total has come to rest when its last two parts differ by no more than this part of it, or
# by no more than so many standard errors of what one batch differs from another...
REST, ERRORS = 0.1, 2.0
# ... but by no more than this, however noisy it is;
LARGEST_CHANGE = 0.25
# ... and has been stable when no part of the second half exceeds the end by this factor.
STABLE = 1.5

FIELDS_TABLE = SeedsTable(
    "overview_fields",
    "Agents from a grid over the box in every trained field, over the seeds. A field is "
    "followed where all starts lap, and on both pieces. RMS and largest distance from the "
    "path are over the last lap of those that settled; |m| is the speed on the path at a "
    "commanded speed of one. The robust recipe may start again, the paper's does not.",
    {
        "reach": ("reach", pd.Series.mean),
        "lap": ("lap", SHARE),
        "fields followed": ("followed", partial(fraction_columns, "fields followed")),
        "RMS, U": ("rms_u", POSITIVE),
        "largest, U": ("max_u", POSITIVE),
        "least |m|": ("speed_min", POSITIVE),
        "largest |m|": ("speed_max", POSITIVE),
        "training, s CPU": ("train_cpu_s", POSITIVE),
    },
)
LOSSES_CAPTION = (
    "The losses of the tangent network, each times its weight, mean over the seeds: in the "
    "first and the last tenth of the training, the change of the last from the tenth before, "
    "and the highest tenth of the second half; both in per cent of the last. (The learning "
    "rate of the robust recipe falls to zero.)"
)


@dataclass(frozen=True)
class OverviewTrial:
    """A training of a shape by a recipe; the rest is as in `Overview`."""

    shape: str
    recipe: str
    seed: int
    starts: int


def measure_overview(trial: OverviewTrial, folder: Path) -> Row:
    """Trains a field and follows it; leaves the field, its losses and one agent a piece.

    Returns:
        What `following` and `measure_score` do; pieces, pieces_lapped: their number, and of
        how many agents lap; all_lap: whether all do; losses: see `tangent_courses`;
        restarts; train_cpu_s.
    """
    cloud, path = make_shape(trial.shape, seed=trial.seed)
    result = trained(cloud, trial.recipe, trial.seed)
    duration = RECIPES[trial.recipe].patience * default_duration(path, cloud.unit_length)
    run = follow(result.guiding_field, path, trial.starts, duration)
    result.guiding_field.save(folder / FIELD)
    result.history.to_parquet(folder / LOSSES, index=False)
    agents = run.positions[::THINNING, far_starts(run, path)]
    np.save(folder / AGENTS, agents.astype(np.float32))
    lapped = run.metrics.lapped
    return {
        **following(run, cloud.unit_length),
        **measure_score(result.guiding_field, path, trial.seed),
        "pieces": len(path.pieces),
        "pieces_lapped": len(np.unique(run.metrics.piece[lapped])),
        "all_lap": bool(lapped.all()),
        "losses": tangent_courses(result.history),
        "restarts": result.restarts,
        "train_cpu_s": result.cpu_s,
    }


def far_starts(run: FollowResult, path: ReferencePath) -> list[int]:
    """Returns one agent for each piece: of the starts nearest to it, the farthest away.

    What becomes of it has no part in the choice.
    """
    found = path.project(run.positions[0])
    return [
        int(np.argmax(np.where(found.piece == piece, found.distance, -1.0)))
        for piece in range(len(path.pieces))
    ]


def tangent_courses(history: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Returns the course of every loss of the tangent network, and of their total."""
    tangent = history[history["stage"] == "tangent"].dropna(axis=1, how="all")
    return {str(term): course(tangent[term]) for term in tangent.columns[2:]}


def course(losses: pd.Series) -> dict[str, float]:
    """Returns the course of a loss, given at even steps of the training.

    Returns:
        begin: mean over the first part of the training; end: over the last part; change: of
        the last part from the one before, relative to the end; error: the standard error of
        that change; peak: the highest part of the second half, relative to the end.
    """
    parts = np.array_split(losses.to_numpy(dtype=np.float64), PARTS)
    means = [float(part.mean()) for part in parts]
    variance = sum(float(part.var(ddof=1)) / len(part) for part in parts[-2:])
    end = means[-1]
    scale = max(end, float(np.finfo(np.float64).tiny))
    return {
        "begin": means[0],
        "end": end,
        "change": (end - means[-2]) / scale,
        "error": float(np.sqrt(variance)) / scale,
        "peak": max(means[PARTS // 2 :]) / scale,
    }


def converged(loss: Mapping[str, float]) -> bool:
    """Whether a loss fell, came to rest, and was stable on the way, from its `course`."""
    rests = abs(loss["change"]) <= min(max(REST, ERRORS * loss["error"]), LARGEST_CHANGE)
    return loss["end"] < loss["begin"] and rests and loss["peak"] <= STABLE


@dataclass
class Overview(Experiment):
    """Trains and follows the two headline shapes in several recipes.

    Attributes:
        shapes: Names of `SHAPES`, of closed pieces.
        recipes: The recipes, in the order of the rows of the figures.
        starts: Agents on a grid over the box of each shape.
        seeds: Seeds of clouds and trainings; the figures show the first.
    """

    shapes: list[str] = field(
        default_factory=lambda: ["concentric-circles", "separated-circles"]
    )
    recipes: list[str] = field(default_factory=lambda: ["paper", "robust"])
    starts: int = 100
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def measure(self, bench: Workbench) -> Rows:
        trials = [
            OverviewTrial(shape, recipe, seed, self.starts)
            for shape in self.shapes
            for recipe in self.recipes
            for seed in self.seeds
        ]
        return {"fields": run_trials(bench, measure_overview, trials, "overview")}

    def claims(self) -> Sequence[Claim]:
        return CLAIMS.of_recipes(self.recipes)

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        fields = rows["fields"]
        first = fields[fields["seed"] == self.seeds[0]]
        return [
            Exhibit(
                f"overview_{shape}",
                f"{shape}, seed {self.seeds[0]}, a row a recipe: score, tangent, losses of the "
                "tangent network, and two agents, for each piece the one that starts farthest "
                "from it (dots: starts).",
                overview_figure(dict(zip(own["recipe"], own[FOLDER], strict=True))),
            )
            for shape, own in first.groupby("shape", sort=False)
        ]

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        losses = pd.DataFrame(
            {
                **{"shape": field["shape"], "recipe": field["recipe"], "loss": term},
                **{"first tenth": loss["begin"], "last tenth": loss["end"]},
                "change, %": 100 * loss["change"],
                "highest later, %": 100 * loss["peak"],
            }
            for field in rows["fields"].to_dict("records")
            for term, loss in field["losses"].items()
        )
        means = losses.groupby(["shape", "recipe", "loss"], sort=False).mean().reset_index()
        fields = rows["fields"].assign(followed=followed(rows["fields"]))
        return [
            FIELDS_TABLE.of(fields, ("shape", "recipe")),
            Exhibit("overview_losses", LOSSES_CAPTION, means),
        ]


def followed(fields: pd.DataFrame) -> "pd.Series[bool]":
    """Returns in which fields all starts lap, on all pieces."""
    return fields["all_lap"].astype(bool) & (fields["pieces_lapped"] == fields["pieces"])


def overview_figure(folders: Mapping[str, Path]) -> Figure:
    """Draws one row a recipe: score field, tangent field, losses, two agents (Fig. 2)."""
    figure, axes = plotting.new_figure(len(folders), 4, 13, 3.5 * len(folders))
    for number, (recipe, folder) in enumerate(folders.items()):
        field = load_guiding_field(folder / FIELD)
        history = pd.read_parquet(folder / LOSSES)
        score, tangent, losses, plane = axes[4 * number : 4 * number + 4]
        for each, part, title in (
            (score, ScoreField(field), "score S"),
            (tangent, TangentField(field), "tangent v"),
            (plane, field, "two agents in m = s + v"),
        ):
            box, points = field.cloud.box, field.cloud.points
            plotting.plot_plane(each, part, box, points, f"{recipe}: {title}")
        plotting.plot_losses(losses, history[history["stage"] == "tangent"])
        losses.set_title(f"{recipe}: losses of v")
        agents = np.load(folder / AGENTS).transpose(1, 0, 2)
        for agent, color in zip(agents, cycle(AGENT_COLORS), strict=False):
            plane.plot(*agent.T, color=color, linewidth=1.5)
            # A start may lie on the border.
            plane.plot(*agent[0], "o", color=color, markersize=6, clip_on=False)
    return figure


SECTION = "Section V-A, Fig. 2"
CLAIMS = Claims()
"""What is claimed of each recipe."""


@CLAIMS.add("overview-score", SECTION)
def _score(rows: Rows) -> Judged:
    """The learned score shows the density of the waypoints {}."""
    # Compares the scores with the exact one, near the path.
    fields = rows["fields"]
    mean, low = fields["score_cosine"], fields["score_cosine_p5"]
    shown = Count.of((mean >= MEAN_COSINE) & (low >= LOW_COSINE))
    return {
        "fields that show it": shown,
        "mean cosine with the exact score": Span.of(mean),
        "5th percentile": Span.of(low),
    }, Verdict.every(shown)


@CLAIMS.add("overview-losses", SECTION)
def _losses(rows: Rows) -> Judged:
    """The tangent losses converge and are stable {}."""
    # Counts the trainings whose total tangent loss fell, came to rest, and was stable.
    totals = [losses["total"] for losses in rows["fields"]["losses"]]
    rested = Count.of(map(converged, totals))
    return {
        "trainings at rest": rested,
        "total in the first tenth": Span.of(total["begin"] for total in totals),
        "in the last tenth": Span.of(total["end"] for total in totals),
        "largest change to the last tenth": Share(max(abs(one["change"]) for one in totals)),
    }, Verdict.every(rested)


@CLAIMS.add("overview-tracking", SECTION)
def _tracking(rows: Rows) -> Judged:
    """Agents track both loops, also disjoint ones {}; measured by more than the two agents of
    the paper: all starts of a grid.
    """
    # Counts the fields in which all starts lap, on all pieces.
    fields = rows["fields"]
    count = Count.of(followed(fields))
    share = fraction_interval(count.good, count.all)
    return {
        "fields followed": count,
        "share of the fields": Mean(*share),
        "starts that lap in the worst field": Share(fields["lap"].min()),
    }, Verdict.every(count)
