"""Fig. 5: where the learned score vanishes, and a field that vanishes nowhere."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist
from matplotlib.figure import Figure
import numpy as np
import pandas as pd
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.stats import binomtest

from sgvf_drake import plotting
from sgvf_drake.arrays import BoolArray
from sgvf_drake.experiments.figures.singularities import (
    MARKS,
    plot_density_map,
    plot_density_surface,
    plot_zeros,
)
from sgvf_drake.experiments.intervals import POSITIVE
from sgvf_drake.experiments.singularities import singularity_summary, zero_rows
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import GuidingField, ScoreField, load_guiding_field
from sgvf_drake.lyapunov import NEAR_PATH, Singularities, find_singularities, measure_vanishing
from sgvf_drake.paper.claims import Claim, Claims, Count, Judged, Rows, Verdict
from sgvf_drake.paper.experiment import FOLDER, Exhibit, Experiment, SeedsTable, run_trials
from sgvf_drake.paper.parametric import ParametricTrial, measure_parametric, plot_helices
from sgvf_drake.paper.training import trained
from sgvf_drake.paths import ReferencePath, make_shape

FIELDS, PARAMETRIC = "fields", "parametric"
"""The tables of the trials: learned fields, and fields in one more dimension."""

FIELD = "field.safetensors"
# Cells along each axis of the box, whose connected parts off the path are its regions.
REGION_CELLS = 201

SECTION = "Section VI-A, Fig. 5"
# A search of the least |chi| ends this near to it.
SEARCH = 1e-6
# A comparison within one field holds by chance this often.
ERROR = 0.05
# The sign of an index, its colour, its marker, and what it is.
INDICES = (
    (1, plotting.BLUE, "o", "index 1: source, sink or focus"),
    (-1, plotting.RED, "x", "index -1: saddle"),
)

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
PARAMETRIC_CAPTION = (
    "The field in one more dimension around each piece: the least |chi| on a grid of states, "
    "after descents from the lowest of them, and the root of 1 + |f'|^2 that follows from the "
    "formula; beside it the zeros of the robust field m of the shape, mean over the seeds. "
    "The speed in the plane does vanish, where a robot waits for its point."
)


@dataclass(frozen=True)
class VanishingTrial:
    """A score that is learned of a shape, by the recipe `robust` or `paper`."""

    shape: str
    recipe: str
    seed: int
    effort: float


@dataclass
class ScoreVanishing(Experiment):
    """Finds where learned scores vanish, against a field that vanishes nowhere.

    Attributes:
        shapes: Shapes whose score the robust recipe learns, the one of the figure first.
        paper_shapes: Shapes whose score the paper's recipe learns as well.
        parametric_points: Number of waypoints, in order, on each piece for the field in one
            more dimension.
        effort: Part of the recipes' iterations.
        seeds: Seeds of the waypoints' order and of the networks.
    """

    shapes: list[str] = field(
        default_factory=lambda: ["concentric-circles", "separated-circles", "square", "star"]
    )
    paper_shapes: list[str] = field(default_factory=lambda: ["concentric-circles", "square"])
    parametric_points: int = 200
    effort: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def measure(self, bench: Workbench) -> Rows:
        learned = [
            VanishingTrial(shape, recipe, seed, self.effort)
            for recipe, shapes in (("robust", self.shapes), ("paper", self.paper_shapes))
            for shape in shapes
            for seed in self.seeds
        ]
        pieces = [ParametricTrial(shape, self.parametric_points) for shape in self.shapes]
        stage = "fields with a parameter"
        return {
            FIELDS: run_trials(bench, measure_score_zeros, learned, "score zeros"),
            PARAMETRIC: run_trials(bench, measure_parametric, pieces, stage),
        }

    def claims(self) -> Sequence[Claim]:
        return CLAIMS

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        fields, by = fields_of(rows).rename(columns={"recipe": "score"}), ("shape", "score")
        # Only the robust recipe has a tangent here, and so a path that m follows.
        least_m = fields.pop("guiding_min_at_score_zeros_on_path")
        fields["least_m"] = least_m.where(fields["score"] == "robust")
        zeros = _robust(zeros_of(rows, "guiding"))["shape"]
        pieces = [
            {
                "shape": trial["shape"],
                "piece": number,
                "least |chi| on the grid": piece["grid"],
                "after descents": piece["least"],
                "by the formula": piece["formula"],
                "least speed in the plane": piece["plane"],
                "zeros of m (SGVF)": zeros.eq(trial["shape"]).sum() / len(self.seeds),
            }
            for trial in rows[PARAMETRIC].to_dict("records")
            for number, piece in enumerate(trial["pieces"], start=1)
        ]
        return [
            *(table.of(fields, by) for table in TABLES),
            Exhibit("singularity_free", PARAMETRIC_CAPTION, pd.DataFrame(pieces)),
        ]

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        seed = self.seeds[0]
        first = _robust(rows[FIELDS]).query("seed == @seed").set_index("shape")[FOLDER]
        fields = {shape: load_guiding_field(first[shape] / FIELD) for shape in self.shapes}
        found = {shape: find_singularities(field) for shape, field in fields.items()}
        shape, around = self.shapes[0], rows[PARAMETRIC].iloc[0]
        figure = vanishing_figure(fields[shape], found[shape], around)
        least = min(piece["least"] for piece in around["pieces"])
        shapes = shapes_figure(fields, found)
        zeros = _robust(zeros_of(rows, "score"))
        return [
            Exhibit("vanishing", FIGURE_CAPTION.format(least=least), figure),
            Exhibit("vanishing_shapes", SHAPES_CAPTION.format(seed=seed), shapes),
            Exhibit("vanishing_zeros", PLACES_CAPTION, places_figure(zeros)),
        ]

    def logs(self, rows: Rows) -> Mapping[str, pd.DataFrame]:
        zeros = zeros_of(rows, "score").drop(columns="on_path")
        return {"score_zeros": zeros.rename(columns={"recipe": "score"})}


def measure_score_zeros(trial: VanishingTrial, folder: Path) -> Row:
    """Finds where a learned score vanishes, and what is there; leaves the field.

    Returns:
        `singularity_summary`, the summary of `measure_vanishing`, the zeros, and the regions
        of the box off the path; see `region_indices`.
    """
    # The zeros of whatever score comes out are asked for; the paper's tangent, which takes
    # most of the time, is not.
    settings = {"robust": {"max_restarts": 0}, "paper": {"tangent_iterations": 1}}
    cloud, path = make_shape(trial.shape, seed=trial.seed)
    own: dict[str, Any] = {"effort": trial.effort, **settings[trial.recipe]}
    field = trained(cloud, trial.recipe, trial.seed, **own).guiding_field
    found = find_singularities(field)
    vanishing = measure_vanishing(field, found, path)
    field.save(folder / FIELD)
    return {
        **singularity_summary(found),
        "sigma": field.mixture.sigma,
        "unit": cloud.unit_length,
        "vanishing": vanishing.summary,
        "zeros": zero_rows(found, vanishing),
        "regions": region_indices(field, found, path),
    }


def region_indices(
    field: GuidingField, found: Singularities, path: ReferencePath
) -> list[dict[str, int]]:
    """Sums the indices of the zeros of the score over each region of the box off the path.

    A region is a connected part of the box farther from the path than `NEAR_PATH` noise
    levels: a hole, what lies between two pieces, or what is outside of all.

    Returns:
        The Euler characteristic of each (1 less its holes), which is what Poincare and Hopf
        have for a field that points out of the region on the path's side and into the box on
        its border; the sum of the indices; and the number of zeros.
    """
    lower, upper = found.box
    steps = (np.arange(REGION_CELLS) + 0.5) / REGION_CELLS
    cells = lower + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1) * (upper - lower)
    near = NEAR_PATH * field.mixture.sigma
    off = path.project(cells.reshape(-1, 2)).distance > near
    labels, count = ndimage.label(off.reshape(REGION_CELLS, REGION_CELLS))
    inside = labels > 0
    x = found.score.points
    indices = np.array([zero.index for zero in found.score.zeros])
    # A zero on the rim may lie in a cell whose middle is nearer to the path.
    of_zero = labels[inside][cKDTree(cells[inside]).query(x)[1]]
    of_zero = np.where(path.project(x).distance > near, of_zero, 0)
    return [
        {
            "euler": 1 - _holes(labels == label),
            "index_sum": int(indices[of_zero == label].sum()),
            "zeros": int((of_zero == label).sum()),
        }
        for label in range(1, count + 1)
    ]


def _holes(region: BoolArray) -> int:
    """Returns how many parts of the rest do not reach the border of the array."""
    # Cells of a region touch along their sides, so those of the rest may touch at corners.
    _, parts = ndimage.label(np.pad(~region, 1, constant_values=True), np.ones((3, 3)))
    return int(parts) - 1


# Tables.


def zeros_of(rows: Rows, field: str) -> pd.DataFrame:
    """Returns one row a zero of the `score` or of the `guiding` field, and what is around it.

    Returns:
        Shape, recipe and seed of the field, and what `zero_rows` says: x and y, index, kind,
        and the rest; the distance from the path in U.
    """
    trials: Any = rows[FIELDS].to_dict("records")
    zeros = pd.json_normalize(trials, "zeros", ["shape", "recipe", "seed", "unit"])
    zeros = zeros[zeros["field"] == field].reset_index(drop=True)
    zeros[["x", "y"]] = np.array(zeros["point"].tolist()).reshape(-1, 2)
    zeros["path_distance"] /= zeros["unit"]
    names = ["index", "kind", "path_distance", "density_percentile", "guiding_norm", "on_path"]
    numbers = {"seed": int, "index": int, "path_distance": float, "on_path": bool}
    return zeros[["shape", "recipe", "seed", "x", "y", *names]].astype(numbers)


def fields_of(rows: Rows) -> pd.DataFrame:
    """Returns one row a field, with a column for each part of the summary of vanishing."""
    fields = rows[FIELDS]
    vanishing = pd.DataFrame(fields["vanishing"].tolist(), index=fields.index)
    return fields.drop(columns="vanishing").join(vanishing)


def regions_of(regions: pd.Series) -> pd.DataFrame:
    """Returns one row a region, from the regions of each field; see `region_indices`."""
    found = [region for own in regions for region in own]
    return pd.DataFrame(found, columns=["euler", "index_sum", "zeros"])


def forced(regions: pd.Series) -> int:
    """Returns the fewest zeros off the path that topology allows, from `regions_of`."""
    return int(regions_of(regions)["euler"].abs().sum())


def as_topology(regions: pd.Series) -> Count:
    """Returns in how many regions the indices add up to the Euler characteristic."""
    found = regions_of(regions)
    return Count.of(found["index_sum"] == found["euler"])


def _robust(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["recipe"] == "robust"]


def _distinct(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(set(numbers))))


def _chance(comparisons: pd.Series) -> str | None:
    known = comparisons.dropna()
    if known.empty:
        return None
    mean = np.mean([comparison["probability"] for comparison in known])
    return f"{mean:.2f} ({_holding(known)})"


def _holding(comparisons: pd.Series) -> Count:
    """Returns how many comparisons hold, of those that can be made."""
    return Count.of(comparison["holds"] for comparison in comparisons.dropna())


TABLES = (
    SeedsTable(
        "vanishing_counts",
        "Zeros of the learned score in each field, means over the seeds: on the path (within "
        "three noise levels) their indices cancel, off it they add up to one. A region is a "
        "connected part of the box off the path; in each the indices add up to its Euler "
        "characteristic. Forced: the fewest zeros off the path that this allows.",
        {
            "zeros on the path": ("zeros_on_path", POSITIVE),
            "zeros off it": ("zeros_off_path", POSITIVE),
            "forced": ("regions", lambda own: forced(own.iloc[:1])),
            "indices on the path": ("index_sum_on_path", _distinct),
            "indices off it": ("index_sum_off_path", _distinct),
            "on the border": ("score_winding_number", _distinct),
            "regions as topology has them": (
                "regions",
                lambda own: str(as_topology(own)),
            ),
        },
    ),
    SeedsTable(
        "vanishing_places",
        "The chance that a zero of the score has a lower density, or a higher curvature of "
        "the path, than a place drawn evenly has; 0.5 where zeros do not care. In brackets "
        "the fields in which it is above 0.5 and not by accident (p < 0.05).",
        {
            "lower density than in the box": ("low_density", _chance),
            "the same off the path": ("low_density_off_path", _chance),
            "higher curvature than along the path": ("high_curvature", _chance),
            "least |m| on the path": ("least_m", pd.Series.min),
            "correlation of |S| and log p": ("density_correlation", pd.Series.mean),
        },
    ),
)


# Claims.

CLAIMS = Claims()


def _more_than_chance(count: Count) -> Verdict:
    """Holds where all comparisons do, in part where more do than errors of 5 % explain."""
    if count.all == 0:
        return Verdict.FAILS
    test = binomtest(count.good, count.all, ERROR, alternative="greater")
    return Verdict.when(count.good == count.all, test.pvalue < ERROR)


@CLAIMS.add("vanishing-indices", SECTION)
def _indices(rows: Rows) -> Judged:
    """The zeros of the learned score obey the theorem of Poincare and Hopf: the sum of their
    indices is fixed by topology, as the Euler characteristic.
    """
    fields = Count.of(
        row["score_index_sum"] == row["score_winding_number"]
        and not row["undecided_by_field"]["score"]
        for row in rows[FIELDS].to_dict("records")
    )
    regions = as_topology(rows[FIELDS]["regions"])
    all_fields, all_regions = (count.good == count.all for count in (fields, regions))
    return {
        "fields where the indices add up to the winding number on the border": fields,
        "regions where they do to the Euler characteristic": regions,
    }, Verdict.when(all_fields and all_regions, all_fields)


@CLAIMS.add("vanishing-is-singularity", SECTION)
def _singularity(rows: Rows) -> Judged:
    """Score vanishing is a singularity that topology forces, and one of the guiding field."""
    fields = _robust(fields_of(rows))
    score, guiding = (_robust(zeros_of(rows, name)) for name in ("score", "guiding"))
    meeting = Count(int(fields["score_zeros_at_guiding_zeros"].sum()), len(score))
    met = int(fields["guiding_zeros_at_score_zeros"].sum())
    on_path = score.loc[score["on_path"], "guiding_norm"]
    return {
        "robust fields": len(fields),
        "zeros of the score at one of m": meeting,
        "zeros that topology forces": forced(fields["regions"]),
        "least |m| at those on the path": float(on_path.min()) if len(on_path) else "none",
        "zeros of m at one of the score": Count(met, len(guiding)),
    }, Verdict.every(meeting)


@CLAIMS.add("vanishing-low-density", SECTION)
def _density(rows: Rows) -> Judged:
    """Score vanishing is pronounced where the density of samples is low."""
    fields, zeros = fields_of(rows), zeros_of(rows, "score")
    everywhere, off_path = (
        _holding(fields[name]) for name in ("low_density", "low_density_off_path")
    )
    # Most zeros are on the path by the density's own shape; the others are the question.
    verdict = _more_than_chance(off_path)
    if verdict is Verdict.HOLDS and everywhere.good < everywhere.all:
        verdict = Verdict.PARTLY
    return {
        "fields whose zeros keep to low density": everywhere,
        "fields whose zeros off the path do": off_path,
        "zeros on the path": Count.of(zeros["on_path"]),
    }, verdict


@CLAIMS.add("vanishing-high-curvature", SECTION)
def _curvature(rows: Rows) -> Judged:
    """Score vanishing is pronounced where the curvature is high."""
    holding = _holding(fields_of(rows)["high_curvature"])
    told = {"fields whose zeros on the path keep to high curvature": holding}
    return told, _more_than_chance(holding)


@CLAIMS.add("vanishing-topology", SECTION)
def _topology(rows: Rows) -> Judged:
    """Score vanishing is pronounced at nontrivial topology, as loops and holes."""
    regions, zeros = regions_of(rows[FIELDS]["regions"]), zeros_of(rows, "score")
    regions = regions[regions["euler"] != 0]
    with_zero, there = Count.of(regions["zeros"] > 0), int(regions["zeros"].sum())
    everywhere = 0 < with_zero.all == with_zero.good
    return {
        "holes, and regions around more than one loop, with a zero": with_zero,
        "zeros that are there": Count(there, len(zeros)),
    }, Verdict.when(everywhere and there > len(zeros) / 2, everywhere)


@CLAIMS.add("vanishing-singularity-free", SECTION)
def _dimension(rows: Rows) -> Judged:
    """A guiding field in one more dimension has no singularity."""
    pieces = pd.DataFrame(rows[PARAMETRIC]["pieces"].explode().tolist())
    found = pieces[["grid", "least"]].min(axis=1)
    least, bounded = float(found.min()), Count.of(found >= (1 - SEARCH) * pieces["formula"])
    return {
        "least |chi| that a grid and descents found": least,
        "pieces where it is what the formula says": bounded,
    }, Verdict.when(least > SEARCH and bounded.good == bounded.all, least > SEARCH)


# Figures.


def vanishing_figure(field: GuidingField, found: Singularities, around: pd.Series) -> Figure:
    """Returns the score with its zeros, the log-density twice, and the field beyond (Fig. 5).

    The last is of the trial of the fields in one more dimension `around` the same shape.
    """
    figure = Figure(figsize=(12.5, 11.5), layout="constrained")
    score, above = figure.add_subplot(2, 2, 1), figure.add_subplot(2, 2, 2)
    surface, beyond = (figure.add_subplot(2, 2, place, projection="3d") for place in (3, 4))
    plotting.plot_field(score, ScoreField(field), found.box)
    marks: dict[str, Artist] = {
        "waypoints": plotting.plot_waypoints(score, field.cloud.points)[0]
    }
    marks |= plot_zeros(score, found.score)
    title = f"(a) learned score, {len(found.score.zeros)} zeros"
    plotting.plane_axes(score, plotting.UNIT, title)
    both = plot_density_map(above, field, found)[-2:]
    above.set_title("(b) log-density from above")
    plot_density_surface(surface, field, found)
    surface.set_title("(c) log-density as a surface")
    plot_helices(beyond, around)
    names = [name for name in ("waypoints", *MARKS) if name in marks]
    handles = [*(marks[name] for name in names), *both]
    both_names = ("zeros of S in (b), (c)", "zeros of m in (b), (c)")
    plotting.legend_below(figure, handles, [*names, *both_names], 4)
    return figure


def shapes_figure(
    fields: Mapping[str, GuidingField], found: Mapping[str, Singularities]
) -> Figure:
    """Returns the log-density of each field with the zeros of its score and of m."""
    columns = min(2, len(fields))
    rows = -(-len(fields) // columns)
    figure, axes = plotting.new_figure(rows, columns, 6.3 * columns, 5.2 * rows + 0.5)
    for panel in axes[len(fields) :]:
        panel.set_axis_off()
    marks: Sequence[Artist] = []
    for panel, (name, learned) in zip(axes, fields.items(), strict=False):
        marks = plot_density_map(panel, learned, found[name])[-2:]
        score, guiding = len(found[name].score.zeros), len(found[name].guiding.zeros)
        panel.set_title(f"{name}: {score} zeros of S, {guiding} of m")
    plotting.legend_below(figure, marks, ["zeros of S", "zeros of m"])
    return figure


def places_figure(zeros: pd.DataFrame) -> Figure:
    """Returns at which densities zeros of the score are, and |m| there; from `zeros_of`."""
    figure, axes = plotting.new_figure(1, 2, 12, 5)
    on_path = zeros["on_path"]
    for own, color, label in (
        (zeros, "black", "all zeros"),
        (zeros[on_path], plotting.BLUE, "on the path"),
        (zeros[~on_path], plotting.RED, "off the path"),
    ):
        if len(own):
            percentile = 100 * own["density_percentile"]
            axes[0].ecdf(percentile, color=color, label=f"{label} ({len(own)})")
    axes[0].plot([0, 100], [0, 1], "--", color=plotting.GREY, label="places drawn evenly")
    axes[0].set(
        xlabel="percentile of the density in the box, %",
        ylabel="share of the zeros up to it",
        title="at which densities the score vanishes",
    )
    for index, color, marker, label in INDICES:
        own = zeros[zeros["index"] == index]
        style: dict[str, Any] = {"s": 22, "color": color, "marker": marker, "label": label}
        axes[1].scatter(own["path_distance"], own["guiding_norm"], **style)
    axes[1].set(
        xlabel="distance from the path [U]",
        ylabel="|m|",
        title="|m| where the score vanishes",
        ylim=(-0.05, 1.1),
    )
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend(loc="best")
    return figure
