"""Fig. 6: what shallow and deep tangent networks do at the corners of polygons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.follow import follow
from sgvf_drake.experiments.intervals import POSITIVE, SHARE, interval
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import GuidingField, ScoreNetwork, load_guiding_field
from sgvf_drake.lyapunov import find_guiding_zeros
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
from sgvf_drake.paper.experiment import (
    FOLDER,
    Exhibit,
    Experiment,
    SeedsTable,
    first,
    run_trials,
)
from sgvf_drake.paper.training import trained
from sgvf_drake.paper.traps import along_sides, examine, paused, polygon

POLYGONS = "polygons"
"""The table of the trials."""

SQUARE, HEXAGON = 4, 6
NAMES = {SQUARE: "square", HEXAGON: "hexagon"}
# Hidden widths of the tangent: the paper's, and its deeper one (Section VI-B).
PAPER_TANGENTS = {"shallow": (128,), "deep": (64, 64, 64, 64)}
NETWORKS = (*PAPER_TANGENTS, "robust")
# The panels of the paper's Fig. 6, and the robust recipe on the sharper of the two.
PANELS = ((SQUARE, "shallow"), (HEXAGON, "shallow"), (HEXAGON, "deep"), (SQUARE, "robust"))
# Of the trajectories every fifth sample is kept, one each quarter of U at unit speed.
THINNING = 5

SECTION = "Section VI-B"
# The chance that a correlation is found by accident.
SIGNIFICANCE = 0.05
# Below this a part of the field counts as vanishing; `sgvf verify` asks as much of m.
SMALL = 0.05
# The range of what may be anything, and of a share in per cent.
ANY, PERCENT = (-math.inf, math.inf), (0.0, 100.0)
# Half the side of the window about a corner, U, and its pixels.
WINDOW, PIXELS = 0.6, 161
# The colours of |m|, and between which values.
NORM_COLORS, NORMS = "viridis", Normalize(0.0, 1.0)
# Colour, marker and shift along the axis of angles, so that intervals do not cover each other.
STYLES = {
    "shallow": (plotting.RED, "o", -1.2),
    "deep": (plotting.BLUE, "s", 0.0),
    "robust": (plotting.GREEN, "^", 1.2),
}


@dataclass(frozen=True)
class CornerTrial:
    """A polygon with so many corners and a seed; the rest is as in `Corners`."""

    corners: int
    seed: int
    num_points: int
    starts: int
    patience: float
    effort: float


@dataclass
class Corners(Experiment):
    """Follows fields of shallow, deep and robust networks around the corners of polygons.

    Attributes:
        angle_polygons: Numbers of corners of further polygons, besides square and hexagon.
        angle_seeds: Seeds of those polygons.
        num_points: Number of waypoints on each, at equal steps from the first corner.
        starts: Number of agents that follow each field.
        patience: How many times as long as usual the agents have, since the paper's fields
            are slow on their path.
        effort: Part of the recipes' iterations.
        seeds: Seeds of square and hexagon: of the order of the waypoints, and of the networks.
    """

    angle_polygons: list[int] = field(default_factory=lambda: [3, 5, 8, 12])
    angle_seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    num_points: int = 240
    starts: int = 100
    patience: float = 4.0
    effort: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])

    def measure(self, bench: Workbench) -> Rows:
        if {SQUARE, HEXAGON} & set(self.angle_polygons):
            raise ConfigurationError(
                "angle_polygons are those besides the square (4) and the hexagon (6), "
                f"not {self.angle_polygons}"
            )
        paper = [(corners, seed) for corners in NAMES for seed in self.seeds]
        angles = [(n, seed) for n in self.angle_polygons for seed in self.angle_seeds]
        trials = [
            CornerTrial(*pair, self.num_points, self.starts, self.patience, self.effort)
            for pair in (*paper, *angles)
        ]
        return {POLYGONS: run_trials(bench, measure_corners, trials, "corners")}

    def claims(self) -> Sequence[Claim]:
        return CLAIMS

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        fields = corner_fields(rows).sort_values("corners", kind="stable")
        shares = ["stalled", "stalled_near", "near", "even", "lapped", "paused", "trapped"]
        fields[shares] *= 100
        fields = fields.rename(columns={"angle": "angle, degrees"})
        by = ("angle, degrees", "network")
        return [table.of(fields, by) for table in TABLES]

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        trials, seed = rows[POLYGONS], self.seeds[0]
        drawn = trials[trials["seed"] == seed].set_index("corners")
        return [
            Exhibit(
                "corners",
                f"Agents from a grid of starts on the square and the hexagon, seed {seed}: the "
                "paper's shallow and deeper tangent, and the robust recipe. Red agents do not "
                "complete a lap, and crosses mark where agents stall.",
                corners_figure(drawn),
            ),
            Exhibit(
                "corners_near",
                "The same fields at the corner where |m| is least: |m| in colour, stream lines "
                "of m, the waypoints and the zeros of m.",
                near_figure(drawn),
            ),
            Exhibit(
                "corner_angles",
                "Top: agents that stall, and corners with a trap nearby, over the angle of the "
                "corners; means over the seeds with 95 % intervals. Bottom left: |m| along the "
                "square past a corner, median over seeds and corners, and from 10 % to 90 % of "
                "them. Bottom right: where the traps near corners sit, all polygons.",
                angles_figure(rows),
            ),
        ]

    def logs(self, rows: Rows) -> Mapping[str, pd.DataFrame]:
        return {"corner_fields": corner_fields(rows).drop(columns="traps")}


def measure_corners(trial: CornerTrial, folder: Path) -> Row:
    """Trains a shallow and a deep tangent on one score of the paper's, and the robust recipe.

    Leaves each field as `NAME.safetensors` and what was seen along it as `NAME.npz`.

    Returns:
        For each network by its name: what agents did, one value each; the zeros of m and
        the size of s there; and what `examine` says.
    """
    cloud = polygon_cloud(trial)
    score: ScoreNetwork | None = None
    results = {}
    options: dict[str, Any] = {"seed": trial.seed, "effort": trial.effort}
    for name, hidden in PAPER_TANGENTS.items():
        results[name] = trained(cloud, "paper", **options, score=score, tangent_hidden=hidden)
        learned = results[name].guiding_field.score_model
        assert isinstance(learned, ScoreNetwork)
        score = learned
    results["robust"] = trained(cloud, "robust", **options)
    return {
        name: {
            **_measure(result.guiding_field, trial, folder / name),
            "restarts": result.restarts,
        }
        for name, result in results.items()
    }


def polygon_cloud(trial: CornerTrial) -> PointCloud:
    """Returns the waypoints of a trial, in random order."""
    points = polygon(trial.corners).pieces[0].sample(trial.num_points)
    return PointCloud(np.random.default_rng(trial.seed).permutation(points))


def _measure(field: GuidingField, trial: CornerTrial, file: Path) -> Row:
    unit, path = field.cloud.unit_length, polygon(trial.corners)
    run = follow(field, path, trial.starts, trial.patience * default_duration(path, unit))
    along = along_sides(field, trial.corners)
    field.save(file.with_suffix(".safetensors"))
    positions = run.positions[::THINNING].astype(np.float32)
    np.savez_compressed(
        file.with_suffix(".npz"), allow_pickle=False, positions=positions, **along
    )
    found = find_guiding_zeros(field)
    s, _ = field.components(found.points)
    summary = run.summary()
    row = {
        "unit": unit,
        "lapped": run.metrics.lapped,
        "stalled": run.metrics.stalled,
        "paused": paused(run, unit),
        "final": run.positions[-1],
        "rms": summary["cross_track_rms"],
        "max": summary["cross_track_max"],
        "zeros": found.points,
        "zeros_stable": [zero.stable for zero in found.zeros],
        "zeros_score": np.linalg.norm(s, axis=1),
        "undecided": found.undecided,
    }
    return row | examine(row, along, trial.corners)


# Tables.


def corner_fields(rows: Rows) -> pd.DataFrame:
    """Returns one row a field: what it is, the figures of `examine`, and its `traps`."""
    table = pd.DataFrame(
        {
            **{"corners": trial["corners"], "angle": 180 - 360 / trial["corners"]},
            **{"network": network, "seed": trial["seed"]},
            **trial[network]["figures"],
            **{name: trial[network][name] for name in ("restarts", "traps")},
        }
        for trial in rows[POLYGONS].to_dict("records")
        for network in NETWORKS
    )
    # Where no field has the figure, the column would be one of objects.
    return table.astype({"near": float, "rms": float, "max": float})


def traps_of(traps: pd.Series) -> pd.DataFrame:
    """Returns one row a trap near a corner, from the traps of each field; see `find_traps`."""
    columns = ["along", "outside", "distance", "score"]
    return pd.DataFrame([one for own in traps for one in own], columns=columns).astype(float)


def _trap_columns(own: pd.Series) -> Row:
    traps = traps_of(own)
    along = traps["along"]
    parts = ((along < 0).sum(), (along >= 0).sum(), along.isna().sum())
    return {
        "traps": len(traps),
        "before / after / clash": " / ".join(map(str, parts)),
        "outside": int((traps["outside"] > 0).sum()),
        "distance, U": traps["distance"].mean(),
    }


TABLES = (
    SeedsTable(
        "corner_stalls",
        "Where agents stall: shares of the starts in per cent, and of those that stall the "
        "share within 0.5 U of a corner, beside the share of the path that is. Paused: those "
        "that stand still for a while and go on.",
        {
            "fields": ("seed", len),
            "stalled, %": ("stalled", PERCENT),
            "stalled near a corner, %": ("stalled_near", PERCENT),
            "near, of the stalled, %": ("near", PERCENT),
            "near, of the path, %": ("even", first),
            "laps, %": ("lapped", PERCENT),
            "paused, %": ("paused", pd.Series.mean),
            "RMS, U": ("rms", pd.Series.mean),
        },
    ),
    SeedsTable(
        "corner_traps",
        "Traps, stable zeros of m on the path within 0.5 U of a corner: the share of corners "
        "that have one, how many sit before and after it in the direction of travel (or where "
        "the sides run against each other) and how many outside of the polygon; and the least "
        "|m| near corners and about the middle of sides, means over them.",
        {
            "fields": ("seed", len),
            "corners with a trap, %": ("trapped", PERCENT),
            "traps": ("traps", _trap_columns),
            "|m| at corners": ("speed_corner", POSITIVE),
            "|m| on sides": ("speed_side", POSITIVE),
        },
    ),
)


# Claims.

CLAIMS = Claims()


def _of(rows: Rows, network: str, *corners: int) -> pd.DataFrame:
    """Returns the fields of a network, on some polygons or on all."""
    fields = corner_fields(rows)
    fields = fields[fields["network"] == network]
    return fields[fields["corners"].isin(corners)] if corners else fields


@CLAIMS.add("corners-shallow-square", f"{SECTION}, Fig. 6 (a)")
def _square(rows: Rows) -> Judged:
    """With a shallow tangent network agents stall near the corners of a square."""
    square = _of(rows, "shallow", SQUARE)
    stalled, near = Mean.of(square["stalled_near"]), square["near"].dropna()
    # The interval of a single value, NaN, shows nothing.
    of_stalled, of_path = Mean.of(near), Share(square["even"].iloc[0])
    return {
        "starts that stall near a corner": stalled,
        "fields where some do": Count.of(square["stalled_near"] > 0),
        "of those that stall": of_stalled if len(near) else "none",
        "of the path": of_path,
    }, Verdict.when(stalled.low > 0 and of_stalled.low > of_path, stalled.mean > 0)


@CLAIMS.add("corners-hexagon-less", f"{SECTION}, Fig. 6 (b)")
def _hexagon(rows: Rows) -> Judged:
    """With a shallow network the corners of a hexagon trap less than those of a square."""
    square, hexagon = (_of(rows, "shallow", corners) for corners in NAMES)
    pairs = square.merge(hexagon, on="seed", suffixes=("", "_hexagon"))
    less = Mean.of(pairs["stalled_near"] - pairs["stalled_near_hexagon"], (-1.0, 1.0))
    return {
        "starts that stall near a corner of the square": Mean.of(square["stalled_near"]),
        "of the hexagon": Mean.of(hexagon["stalled_near"]),
        "difference": less,
        "corners of the square with a trap": Share(square["trapped"].mean()),
        "of the hexagon with a trap": Share(hexagon["trapped"].mean()),
    }, Verdict.when(less.low > 0)


@CLAIMS.add("corners-deep-eliminates", f"{SECTION}, Fig. 6 (c)")
def _deep(rows: Rows) -> Judged:
    """A deeper tangent network eliminates corner attraction entirely."""
    shallow, deep = (_of(rows, network, *NAMES) for network in PAPER_TANGENTS)
    hexagon = deep[deep["corners"] == HEXAGON]
    # Where the field runs against itself, a trap is not the corner's.
    trap = "trapped_locally"
    pairs = shallow.merge(deep, on=["corners", "seed"], suffixes=("", "_deep"))
    less = Mean.of(pairs[trap] - pairs[f"{trap}_deep"], ANY)
    free = Count.of((deep[[trap, "stalled_near", "undecided"]] == 0).all(axis=1))
    return {
        "deep fields free of traps and stalls at corners": free,
        "deep fields where a corner traps": Count.of(deep[trap] > 0),
        "of them hexagons": Count.of(hexagon[trap] > 0),
        "shallow fields": Count.of(shallow[trap] > 0),
        "corners that trap, deep": Share(deep[trap].mean()),
        "corners that trap, shallow": Share(shallow[trap].mean()),
        "difference": less,
        "starts that stall near a corner, deep": Share(deep["stalled_near"].mean()),
        "starts that do, shallow": Share(shallow["stalled_near"].mean()),
        "deep fields whose sides run different ways around": Count.of(deep["turns"] > 0),
    }, Verdict.when(free.good == free.all, less.low > 0)


@CLAIMS.add("corners-pauses", SECTION)
def _pauses(rows: Rows) -> Judged:
    """A shallow network traps the agent for a while: it pauses and goes on."""
    shallow = _of(rows, "shallow", *NAMES)
    slow = Mean.of(shallow["speed_corner"] / shallow["speed_side"], ANY)
    paused, stalled = shallow["paused"].mean(), shallow["stalled"].mean()
    return {
        "least |m| near corners, of that on sides": slow,
        "agents that pause and go on, %": float(100 * paused),
        "agents that never go on": Share(stalled),
    }, Verdict.when(slow.high < 1 and paused > 0 and stalled == 0, slow.high < 1)


@CLAIMS.add("corners-sharper", SECTION)
def _angles(rows: Rows) -> Judged:
    """With a shallow network sharp corners trap more than gentle ones."""
    shallow = _of(rows, "shallow")
    correlation, p_value = 0.0, 1.0
    if len(shallow) > 2 and min(shallow[["angle", "trapped"]].nunique()) > 1:
        correlation, p_value = map(float, spearmanr(shallow["angle"], shallow["trapped"]))
    shares = shallow.groupby("angle")["trapped"].mean()
    return {
        **{
            f"corners of {angle:g} degrees with a trap": Share(x) for angle, x in shares.items()
        },
        "rank correlation with the angle": correlation,
        "p": p_value,
        "fields": len(shallow),
    }, Verdict.when(correlation < 0 and p_value < SIGNIFICANCE)


@CLAIMS.add("corners-tangent-attractor", SECTION)
def _tangent(rows: Rows) -> Judged:
    """The traps of shallow networks are local attractors of the tangent field."""
    # Where m is zero, |v| is |s|.
    norms = traps_of(_of(rows, "shallow")["traps"])["score"]
    small = Count.of(norms < SMALL)
    return {
        "traps near corners": len(norms),
        "|v| there": Span.of(norms) if len(norms) else "none",
        f"below {SMALL}": small,
    }, Verdict.every(small)


# Figures.


def corners_figure(trials: pd.DataFrame) -> Figure:
    """Returns the trajectories in each panel, and where agents stall (paper, Fig. 6).

    Args:
        trials: Those of one seed, by the number of corners.
    """
    figure, axes = plotting.new_figure(2, 2, 10.5, 10.8)
    for panel, (corners, network) in zip(axes, PANELS, strict=True):
        field, found = _field_of(trials, corners, network)
        with np.load(trials[FOLDER][corners] / f"{network}.npz") as stored:
            positions = stored["positions"].astype(np.float64)
        lapped, stalled = (np.array(found[name], bool) for name in ("lapped", "stalled"))
        plotting.plot_field(panel, field, field.cloud.box)
        plotting.plot_trajectories(panel, positions, lapped)
        plotting.plot_waypoints(panel, field.cloud.points)
        final = positions[-1, stalled]
        panel.plot(*final.T, "X", color="black", markersize=9, markeredgecolor="white")
        told = f"{lapped.mean():.0%} lap, {stalled.mean():.0%} stall"
        plotting.plane_axes(panel, plotting.UNIT, f"{NAMES[corners]}, {network}: {told}")
    marks = [
        plotting.mark("agent that laps", color=plotting.BLUE),
        plotting.mark("agent that does not", color=plotting.RED),
        plotting.mark("where agents stall", "X"),
        plotting.mark("waypoints", "."),
    ]
    plotting.legend_below(figure, marks)
    return figure


def _field_of(trials: pd.DataFrame, corners: int, network: str) -> tuple[GuidingField, Row]:
    """Reads the field of a panel; returns it, and what was measured of it."""
    field = load_guiding_field(trials[FOLDER][corners] / f"{network}.safetensors")
    return field, trials[network][corners]


def near_figure(trials: pd.DataFrame) -> Figure:
    """Returns |m|, stream lines, waypoints and zeros in each panel about the slowest corner."""
    figure, axes = plotting.new_figure(2, 2, 10.5, 10.2)
    for panel, (corners, network) in zip(axes, PANELS, strict=True):
        _plot_corner(panel, *_field_of(trials, corners, network))
        panel.set_title(f"{NAMES[corners]}, {network}")
    scale = ScalarMappable(NORMS, NORM_COLORS)
    figure.colorbar(scale, ax=axes, label="|m|", shrink=0.6, extend="max")
    marks = [
        plotting.mark("zero, attracts", "v", "white", mec="black"),
        plotting.mark("zero, other", "o", "white", mec="black"),
        plotting.mark("waypoints", "."),
    ]
    plotting.legend_below(figure, marks)
    return figure


def _plot_corner(axes: Axes, field: GuidingField, found: Row) -> None:
    half = WINDOW * field.cloud.unit_length
    corner = np.array(found["slowest_corner"])
    x, y, points = plane_grid((corner - half, corner + half), PIXELS)
    m = field(points).reshape(PIXELS, PIXELS, 2)
    size = np.linalg.norm(m, axis=2)
    axes.pcolormesh(x, y, size, cmap=NORM_COLORS, norm=NORMS, shading="gouraud")
    axes.streamplot(x, y, m[..., 0], m[..., 1], color="white", density=1.1, linewidth=0.7)
    axes.plot(*field.cloud.points.T, ".", color="black", markersize=5)
    zeros = np.array(found["zeros"]).reshape(-1, 2)
    stable = np.array(found["zeros_stable"], bool)
    for chosen, marker in ((stable, "v"), (~stable, "o")):
        axes.plot(*zeros[chosen].T, marker, color="white", mec="black", markersize=11)
    plotting.plane_axes(axes, plotting.UNIT)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))


def angles_figure(rows: Rows) -> Figure:
    """Returns stalls and traps over the angle, the speed past a corner, and where traps sit."""
    figure, axes = plotting.new_figure(2, 2, 11.5, 9.5)
    trials, fields = rows[POLYGONS], corner_fields(rows)
    squares = trials.loc[trials["corners"] == SQUARE, FOLDER]
    for network, (color, marker, shift) in STYLES.items():
        own = fields[fields["network"] == network]
        for panel, name in zip(axes, ("stalled", "trapped"), strict=False):
            shares = own.groupby("angle")[name]
            means = [[100 * x for x in interval(here, SHARE)] for _, here in shares]
            angles = np.array(list(shares.groups)) + shift
            style: dict[str, Any] = {"color": color, "marker": marker, "label": network}
            plotting.plot_intervals(panel, angles, means, **style)
        # From the middle of one side over the corner to the middle of the next.
        past = np.concatenate([_speed_past_corners(folder, network) for folder in squares])
        part = (np.arange(past.shape[1]) + 0.5) / past.shape[1] - 0.5
        low, median, high = np.quantile(past, [0.1, 0.5, 0.9], axis=0)
        axes[2].fill_between(part, low, high, color=color, alpha=0.15)
        axes[2].plot(part, median, color=color, label=network)
        # Without those at which the sides run against each other, which are past no corner.
        traps = traps_of(own["traps"]).dropna(subset="along")
        label = f"{network}: {len(traps)}"
        style = {"s": 26, "color": color, "marker": marker, "label": label}
        axes[3].scatter(traps["along"], traps["outside"], **style)
    axes[3].axvline(0, color="black", linewidth=0.8)
    axes[3].axhline(0, color="black", linewidth=0.8)
    for panel, label in zip(
        axes, ("agents that stall, %", "corners with a trap, %"), strict=False
    ):
        panel.set(xlabel="angle of the corners [degrees]", xticks=sorted(set(fields["angle"])))
        panel.set(ylabel=label, ylim=(-5, 105))
    axes[2].set(xlabel="past the corner of the square [sides]", ylabel="|m| on the path")
    axes[2].set_ylim(0, 1.25)
    axes[3].set_xlabel("past the corner along the way [U], negative before it")
    axes[3].set_ylabel("outside of the polygon [U]")
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend(loc="best")
    return figure


def _speed_past_corners(folder: Path, network: str) -> FloatArray:
    """Returns |m| past each corner in the direction in which most sides run."""
    with np.load(folder / f"{network}.npz") as stored:
        speed, clockwise = stored["speed"], stored["progress"].mean() < 0
    if clockwise:
        speed = speed[::-1, ::-1]
    return np.roll(speed, speed.shape[1] // 2)
