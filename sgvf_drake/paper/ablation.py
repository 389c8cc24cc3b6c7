"""Recipes complete and without each of their parts: how they are trained, measured and told.

The variants of a training differ in nothing but the part that is taken out, so that what the
part does is seen seed by seed.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.experiments.follow import follow
from sgvf_drake.experiments.intervals import (
    POSITIVE,
    SHARE,
    interval,
)
from sgvf_drake.experiments.quality.measures import following, measure_score
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import (
    Field,
    GuidingField,
    ScoreNetwork,
    TangentField,
    load_guiding_field,
)
from sgvf_drake.lyapunov import verify
from sgvf_drake.lyapunov.band import SIGMA_RATIOS
from sgvf_drake.metrics import default_duration
from sgvf_drake.paper.along_path import (
    direction_row,
    directions,
    drift_row,
    lengths_row,
    sample_path,
)
from sgvf_drake.paper.claims import Rows
from sgvf_drake.paper.experiment import (
    FOLDER,
    Column,
    Exhibit,
    Experiment,
    Range,
    SeedsTable,
    run_trials,
)
from sgvf_drake.paper.training import trained
from sgvf_drake.paths import ReferencePath, make_shape, shape_path

COMPLETE = "complete"
"""The variant that lacks nothing."""

VARIANTS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    COMPLETE: ("complete", {}),
    "no-unit": ("no unit length", {"unit_weight": 0.0}),
    "no-orthogonality": ("no orthogonality", {"orthogonality_weight": 0.0}),
    "no-direction": ("no directional consistency", {"direction_weight": 0.0}),
    "noisy-target": ("noisy target", {"exact_target": False}),
    "no-features": ("no Fourier features", {"num_frequencies": 0}),
    "no-hint": ("no hint", {"hint_weight": 0.0}),
    "no-projection": ("no projection", {"projection": False}),
}
"""What each variant is called, and its options of the training; the keys name its files."""

OF_THE_SCORE = ("noisy-target", "no-features")
"""The variants that learn another score; the others share that of the complete recipe."""

FIELDS = "fields"
"""The name of the table of both ablations, of one row a field."""

SPEED_ERROR = "following.speed_error"
"""The largest | |m| - 1 | on the path, from the speeds of `quality.measures.following`."""

ANY: Range = (-np.inf, np.inf)

FOLLOWED: Mapping[str, Column] = {
    "reach": ("following.reach", SHARE),
    "lap": ("following.lap", SHARE),
    "stall": ("following.stall", SHARE),
    "leave": ("following.leave", SHARE),
    "RMS, U": ("following.rms_u", POSITIVE),
}
"""Columns that say how well a field is followed; see `SeedsTable`."""

# In the file of a run: (n, 2) the last positions of its agents, (n,) whether each lapped.
ENDS, LAPPED = "ends", "followed"
# Arrows along each side of a field, and measures in a row.
ARROWS, COLUMNS = 23, 3
SOURCE, SINK, STOPPED = "^", "v", "o"
# How far apart groups and seeds are drawn beside a tick, in ticks.
GROUP_OFFSET, SEED_OFFSET = 0.3, 0.07
COLORS = (plotting.BLUE, plotting.ORANGE, plotting.GREEN, plotting.RED)
# Without the palest colours, which do not show on white.
LENGTHS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.3, 1, 256)))


@dataclass(frozen=True)
class AblationTrial:
    """A recipe complete, and without each of some parts; the rest is as in `Ablation`.

    Attributes:
        recipe: The recipe.
        shape: A named shape of closed pieces.
        hidden: Hidden widths of the tangent network; None: those of the recipe.
        variants: The variants beside the complete recipe.
        patience: The time of the agents, in the usual one for a field of unit length.
    """

    recipe: Literal["paper", "robust"]
    shape: str
    seed: int
    hidden: tuple[int, ...] | None
    variants: tuple[str, ...]
    starts: int
    patience: float
    ratios: tuple[float, ...]
    score_iterations: int
    tangent_iterations: int


def measure_ablation(trial: AblationTrial, folder: Path) -> Row:
    """Trains and measures all variants; leaves `VARIANT.safetensors` and `VARIANT.npz`.

    They begin with the same networks and the same random numbers.  No training starts again,
    so that what is measured is the first attempt.

    Returns:
        For each variant following: see `followed_row`; check: see `checked_row`; score: see
        `quality.measures.measure_score`; lengths: see `lengths_row`; drift: see `drift_row`;
        tangent, whole: see `direction_row`, of v and of m; passed: whether the self-check
        did; train_cpu_s, of the score only where it was learned.
    """
    cloud, reference = make_shape(trial.shape, seed=trial.seed)
    unit, samples = cloud.unit_length, sample_path(reference, cloud.unit_length)
    rows: Row = {}
    shared: ScoreNetwork | None = None
    for name in (COMPLETE, *trial.variants):
        result = trained(
            cloud,
            trial.recipe,
            trial.seed,
            score=None if name in OF_THE_SCORE else shared,
            max_restarts=0,
            score_iterations=trial.score_iterations,
            tangent_hidden=trial.hidden,
            tangent_iterations=trial.tangent_iterations,
            **VARIANTS[name][1],
        )
        field = result.guiding_field
        if name == COMPLETE:
            assert isinstance(field.score_model, ScoreNetwork)
            shared = field.score_model
        field.save(folder / f"{name}.safetensors")
        run = folder / f"{name}.npz"
        v, m = field.tangent(samples.points), field(samples.points)
        rows[name] = {
            "following": followed_row(field, reference, trial.starts, trial.patience, run),
            "check": checked_row(field, reference, trial.ratios),
            "score": measure_score(field, reference, trial.seed),
            "lengths": lengths_row(field, reference),
            "drift": drift_row(field, reference, samples),
            "tangent": direction_row(directions(samples, v, unit)),
            "whole": direction_row(directions(samples, m, unit)),
            "passed": result.self_check.passed,
            "train_cpu_s": result.cpu_s,
        }
    return rows


def followed_row(
    field: GuidingField, reference: ReferencePath, starts: int, patience: float, file: Path
) -> Row:
    """Follows a field in one diagram; leaves in a file where its agents ended.

    Returns:
        What `quality.measures.following` does; `followable`: whether every agent completed a
        lap, and some did on each piece.
    """
    unit = field.cloud.unit_length
    run = follow(field, reference, starts, patience * default_duration(reference, unit))
    metrics = run.metrics
    np.savez(file, **{ENDS: run.positions[-1], LAPPED: metrics.lapped})
    lapped_on = [(metrics.piece == piece).any() for piece in range(len(reference.pieces))]
    return {
        **following(run, unit),
        "followable": bool(metrics.lapped.all() and all(lapped_on)),
    }


def checked_row(field: GuidingField, reference: ReferencePath, ratios: Sequence[float]) -> Row:
    """Passes a field through the sublevel checks; see `lyapunov.verify`.

    Returns:
        holds, reason; band: whether V falls on a band of levels about a tube along the path;
        zeros: number of zeros of m that count against it; slowest: the smallest |m| in the
        tube, or near the path; falls: part of the box where V falls; cosine: the paper's
        eps, the mean of |cos(s, v)| over the box; length_error: the mean of | |m| - 1 |
        there.
    """
    found = verify(field, reference, ratios=ratios)
    return {
        "holds": found.holds,
        "reason": found.reason,
        "band": found.band is not None,
        "zeros": sum(v.counts and v.kind == "zero" for v in found.violations),
        "slowest": found.slowest,
        "falls": found.decrease_fraction,
        "cosine": found.assumptions["a2_cosine"]["mean"],
        "length_error": found.assumptions["a2_length_error"]["mean"],
    }


def fields_table(trials: pd.DataFrame) -> pd.DataFrame:
    """Returns one row a field from rows of trials, each with a column for each variant.

    Returns:
        Columns shape, network (as the paper writes it: [2,128,2]), seed, variant, folder,
        and one a measure: "part.name".
    """
    labels = ("shape", "seed", FOLDER)
    rows = [
        {
            **{name: trial[name] for name in labels},
            "network": trial["hidden"] and str([2, *trial["hidden"], 2]).replace(" ", ""),
            "variant": variant,
            **trial[variant],
        }
        for trial in trials.to_dict("records")
        for variant in (COMPLETE, *trial["variants"])
    ]
    fields = pd.json_normalize(rows)
    slow, fast = 1 - fields["following.speed_min"], fields["following.speed_max"] - 1
    return fields.assign(**{SPEED_ERROR: pd.concat([slow, fast], axis=1).max(axis=1)})


@dataclass(frozen=True)
class Effect:
    """A measure of the complete recipe, of the one without a part, and the change.

    Intervals are a mean over the seeds with the ends of its 95 % interval.

    Attributes:
        complete: Interval of the complete recipe.
        removed: Interval of the one without the part.
        change: Interval of the differences of the same seed, removed less complete; of the
            logarithms for a factor.
        seeds: The values without the part, one a seed.
        is_factor: Whether the change is told as a factor.
    """

    complete: tuple[float, float, float]
    removed: tuple[float, float, float]
    change: tuple[float, float, float]
    seeds: tuple[float, ...]
    is_factor: bool = False

    def rises(self) -> bool:
        """Whether the interval of the change is above zero; never so for a single seed."""
        return self.change[1] > 0

    def falls(self) -> bool:
        """Whether it is below zero."""
        return self.change[2] < 0

    def __str__(self) -> str:
        told = f"{self.complete[0]:.2g} -> {self.removed[0]:.2g}"
        if np.isnan(self.change[1]):
            return told
        if self.is_factor:
            mean, low, high = np.exp(self.change)
            return f"{told}, a factor of {mean:.2g} [{low:.2g}, {high:.2g}]"
        mean, low, high = self.change
        return f"{told}, change {mean:+.2g} [{low:+.2g}, {high:+.2g}]"


def effect_of(
    table: pd.DataFrame,
    measure: str,
    variant: str,
    *,
    factor: bool = False,
    comparisons: int = 1,
) -> Effect:
    """Returns the effect of a variant on a measure.

    Seeds at which either value is missing are left out of the change.

    Args:
        table: One row a variant and seed, columns variant, seed and the measure.
        measure: The column.
        variant: The variant that lacks the part.
        factor: Whether the change is a factor, as for a length that may grow without bounds,
            of which a few seeds otherwise say little.
        comparisons: The number of changes that are judged together; see `interval`.
    """
    values = table.pivot(index="seed", columns="variant", values=measure).astype(float)
    with_part, without = values[COMPLETE].to_numpy(), values[variant].to_numpy()
    change = np.log(without / with_part) if factor else without - with_part
    return Effect(
        complete=interval(with_part),
        removed=interval(without),
        change=interval(change, comparisons=comparisons),
        seeds=tuple(without),
        is_factor=factor,
    )


@dataclass(frozen=True)
class MeasurePanel:
    """A measure to be drawn over the variants.

    Attributes:
        measure: Its column.
        label: What it is, with the unit; above the panel.
        within: The range of its means.
        log: Whether the axis is logarithmic; the means are then geometric.
    """

    measure: str
    label: str
    within: Range = POSITIVE
    log: bool = False

    def mean(self, values: FloatArray) -> tuple[float, float, float]:
        """Returns the mean of the values of the seeds, with its interval."""
        if self.log:
            mean, low, high = np.exp(interval(np.log(values)))
            return float(mean), float(low), float(high)
        return interval(values, self.within)


@dataclass
class Ablation(Experiment):
    """Trains a recipe complete and without each of its parts.

    Attributes:
        starts: Agents on a grid over the box.
        ratios: The noise levels of V that the sublevel checks try, in those of the field.
        score_iterations: Optimisation steps of the score network.
        tangent_iterations: Optimisation steps of the tangent network.
        seeds: Seeds of the clouds and the trainings; the first is drawn.
    """

    starts: int = 100
    ratios: list[float] = field(default_factory=lambda: list(SIGMA_RATIOS))
    score_iterations: int = 10_000
    tangent_iterations: int = 10_000
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])

    # What a kind says of itself: the column that tells trials of the same seed apart, what is
    # drawn of the fields and which of its lengths are told apart by colour, the captions of
    # the figures of fields (with {} for the seed) and of measures, and what these and the
    # tables tell.
    group: ClassVar[str]
    symbol: ClassVar[Literal["v", "m"]]
    span: ClassVar[Range]
    captions: ClassVar[tuple[str, str]]
    panels: ClassVar[Sequence[MeasurePanel]]
    seeds_tables: ClassVar[Sequence[SeedsTable]]

    @abstractmethod
    def cells(self) -> Sequence[Mapping[str, Any]]:
        """Returns what tells the trials of one seed apart, by the fields of a trial."""

    def measure(self, bench: Workbench) -> Rows:
        trials = [
            AblationTrial(
                seed=seed,
                starts=self.starts,
                ratios=tuple(self.ratios),
                score_iterations=self.score_iterations,
                tangent_iterations=self.tangent_iterations,
                **cell,
            )
            for seed in self.seeds
            for cell in self.cells()
        ]
        return {FIELDS: fields_table(run_trials(bench, measure_ablation, trials, "ablation"))}

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        names = [VARIANTS[variant][0] for variant in rows[FIELDS]["variant"]]
        fields = rows[FIELDS].assign(variant=names)
        return [table.of(fields, (self.group, "variant")) for table in self.seeds_tables]

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        fields, seed, (drawn, measured) = rows[FIELDS], self.seeds[0], self.captions
        of_seed = fields[fields["seed"] == seed]
        variants = variants_figure(of_seed, self.group, self.symbol, self.span)
        return [
            Exhibit("fields", drawn.format(seed), variants),
            Exhibit("measures", measured, measures_figure(fields, self.group, self.panels)),
        ]

    def logs(self, rows: Rows) -> Mapping[str, pd.DataFrame]:
        return {FIELDS: rows[FIELDS].drop(columns=FOLDER, errors="ignore")}


def variants_figure(
    fields: pd.DataFrame, group: str, symbol: Literal["v", "m"], span: Range
) -> Figure:
    """Returns fields side by side: a row for each group, a column for each variant.

    Args:
        fields: One row a field, of one seed: columns shape, variant, folder and the group.
        group: The column that tells the rows apart.
        symbol: What is drawn.
        span: The lengths that are told apart by colour; shorter and longer ones look like
            these.
    """
    groups, columns = list(fields.groupby(group, sort=False)), fields["variant"].nunique()
    figure, axes = plotting.new_figure(
        len(groups), columns, 2.7 * columns + 0.8, 2.6 * len(groups) + 0.8
    )
    panels = iter(axes)
    for row, (name, own) in enumerate(groups):
        label = f"{symbol} by {name!s}" if group == "network" else str(name)
        for one, panel in zip(own.to_dict("records"), panels, strict=False):
            stem, reference = one[FOLDER] / one["variant"], shape_path(one["shape"])
            arrows = _draw_field(panel, stem, reference, symbol, span)
            title = VARIANTS[one["variant"]][0] if row == 0 else ""
            plotting.plane_axes(panel, plotting.UNIT, title)
            panel.label_outer()
        axes[row * columns].set_ylabel(f"{label}\ny [{plotting.UNIT}]")
    figure.colorbar(arrows, ax=axes, label=f"$|{symbol}|$", extend="both", pad=0.01)
    turn = {"color": "white", "markeredgecolor": "black"}
    marks = [
        plotting.mark("waypoint", "o", plotting.BLUE, markersize=4),
        plotting.mark(f"{symbol} parts on the path (source)", SOURCE, **turn),
        plotting.mark(f"{symbol} meets on the path (sink)", SINK, **turn),
        plotting.mark("end of a failed agent", STOPPED, plotting.RED),
    ]
    plotting.legend_below(figure, marks)
    return figure


def _draw_field(
    axes: Axes,
    stem: Path,
    reference: ReferencePath,
    symbol: Literal["v", "m"],
    span: Range,
) -> Quiver:
    """Draws a stored field, and what keeps agents from following it.

    Arrows of one length and waypoints are coloured by the length of what is drawn.
    """
    field = load_guiding_field(stem.with_suffix(".safetensors"))
    run = np.load(stem.with_suffix(".npz"))
    part: Field = TangentField(field) if symbol == "v" else field
    cloud = field.cloud
    _, _, x = plane_grid(cloud.box, ARROWS)
    vectors = part(x)
    length = np.linalg.norm(vectors, axis=1)
    unit = vectors / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    colors: dict[str, Any] = {"cmap": LENGTHS, "norm": LogNorm(*span)}
    arrows = axes.quiver(
        *x.T, *unit.T, length, **colors, pivot="mid", scale=1.15 * ARROWS, width=0.006
    )
    lengths = np.linalg.norm(part(cloud.points), axis=1)
    axes.scatter(cloud.points[:, 0], cloud.points[:, 1], s=14, c=lengths, **colors)
    axes.plot(*run[ENDS][~run[LAPPED]].T, STOPPED, color=plotting.RED, markersize=5)
    samples = sample_path(reference, cloud.unit_length)
    for piece in directions(samples, part(samples.points), cloud.unit_length):
        for points, mark in ((piece.sources, SOURCE), (piece.sinks, SINK)):
            axes.plot(*points.T, mark, color="white", markeredgecolor="black", markersize=8)
    return arrows


def measures_figure(table: pd.DataFrame, group: str, panels: Sequence[MeasurePanel]) -> Figure:
    """Returns measures over the variants: every seed, and means with 95 % intervals.

    Args:
        table: One row a field, columns variant, the group and the measures.
        group: The column that tells the colours apart.
        panels: The measures.
    """
    names = {name: VARIANTS[name][0] for name in table["variant"].unique()}
    rows = -(-len(panels) // COLUMNS)
    figure, axes = plotting.new_figure(rows, COLUMNS, 3.8 * COLUMNS, 3.0 * rows + 0.6)
    groups = list(table.groupby(group, sort=False))
    for panel, own in zip(panels, axes, strict=False):
        for number, (name, fields) in enumerate(groups):
            values = fields.pivot(index="seed", columns="variant", values=panel.measure)
            by_variant = values[[*names]].to_numpy(dtype=np.float64)
            style: dict[str, Any] = {"color": COLORS[number % len(COLORS)], "markersize": 5}
            x = np.arange(len(names)) + GROUP_OFFSET * (number - (len(groups) - 1) / 2)
            means = [panel.mean(here) for here in by_variant.T]
            plotting.plot_intervals(own, x, means, fmt="o", label=str(name), **style)
            beside = np.linspace(-1, 1, len(values)) if len(values) > 1 else np.zeros(1)
            own.plot(SEED_OFFSET * beside[:, None] + x, by_variant, ".", alpha=0.35, **style)
        own.set_xticks(range(len(names)), list(names.values()), rotation=20, ha="right")
        # Without any value there is no logarithmic axis.
        log = panel.log and table[panel.measure].notna().any()
        own.set(title=panel.label, yscale="log" if log else "linear")
        own.grid(axis="y", alpha=0.3)
    for spare in axes[len(panels) :]:
        spare.set_axis_off()
    plotting.legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure
