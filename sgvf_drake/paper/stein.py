"""Section II-B: Stein's identity, of the exact score, the learned ones and the squashed one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter
import numpy as np
import pandas as pd
from scipy import stats

from sgvf_drake import plotting
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.experiments.intervals import interval_columns, over_seeds
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import FloatArray, GaussianMixture, ScoreNetwork
from sgvf_drake.paper.claims import Claim, Claims, Judged, Rows, Share, Span, Verdict
from sgvf_drake.paper.experiment import Exhibit, Experiment, run_trials
from sgvf_drake.paper.moments import CHUNK, SQUASHED, collect, make_probes
from sgvf_drake.paper.training import trained

SCORES = "scores"
"""The table of the trials."""

EXACT = "exact"
"""The score in closed form; the other ones are learned, and go by their recipe."""

RECIPE_NAMES = {"robust": "robust recipe", "paper": "paper's recipe"}
SQUASHED_NAME = "exact, squashed"
RESCALED_NAME = "exact, squashed and rescaled"

SAMPLING = "uniform"
# Waypoints ten times denser on one side: on an even shape, means vanish by symmetry alone.
LOPSIDED = ("circle", "uneven")
# Noise level of the exact mixture: the data end of the paper's schedule as we take it.
SIGMA = 0.1

SECTION, NORMALISED = "Section II-B", "Section III-B, Eq. (2)"
# With the number of draws a residual falls by the power -1/2; the fitted power is known to
# a few hundredths.
SLOPE, SLOPE_TOLERANCE = -0.5, 0.05
# A learned score keeps the identity in part where its residual is at most this part of what
# the identity says.
PART = 0.2
# Of the residual E[S f^T] + E[grad f] in the plane.
ENTRIES = 4
# Chance at which a set of true identities is taken for false.
SIGNIFICANCE = 0.01

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

# Colour and marker of the scores, in their order.
STYLES = (
    ("black", "o"),
    (plotting.GREEN, "^"),
    (plotting.BLUE, "s"),
    (plotting.RED, "D"),
)


@dataclass(frozen=True)
class SteinTrial:
    """A score, `EXACT` or of the recipe that learns it; the rest is as in `SteinIdentity`."""

    cloud: str
    sampling: str
    score: str
    seed: int
    draws: int


@dataclass
class SteinIdentity(Experiment):
    """Puts scores to Stein's identity E[S f^T] = -E[grad f], by Monte Carlo.

    Attributes:
        cloud: Path of the cloud whose density and scores are tested, one of `clouds.PATHS`.
        recipes: Recipes that learn a score.
        draws: Number of samples of the density, for each seed; a multiple of 20,000.
        seeds: Seeds of the training and the draws.
    """

    cloud: str = "concentric-circles"
    recipes: list[str] = field(default_factory=lambda: ["robust", "paper"])
    draws: int = 500_000
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])

    def measure(self, bench: Workbench) -> Rows:
        if self.draws < CHUNK or self.draws % CHUNK:
            raise ConfigurationError(
                f"draws must be a positive multiple of {CHUNK}, not {self.draws}"
            )
        places = [(self.cloud, SAMPLING, score) for score in (EXACT, *self.recipes)]
        places.append((*LOPSIDED, EXACT))
        trials = [
            SteinTrial(*place, seed, self.draws) for place, seed in product(places, self.seeds)
        ]
        return {SCORES: run_trials(bench, measure_stein, trials, "Stein's identity")}

    def claims(self) -> Sequence[Claim]:
        learned = [
            Claim(
                f"stein-learned-{recipe}",
                SECTION,
                f"The learned score satisfies Stein's identity (recipe {recipe}).",
                partial(_learned, recipe=recipe),
                of_paper=recipe == "paper",
            )
            for recipe in RECIPE_NAMES
            if recipe in self.recipes
        ]
        return [*CLAIMS[:2], *learned, *CLAIMS[2:]]

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        found = findings(rows)
        scores = pd.DataFrame(
            {
                **{"waypoints": one["density"], "score": one["score"]},
                **interval_columns("residual, %", 100 * _rms(one["residuals"], axis=1)),
                "largest entry, std. errors": one["z"],
                **interval_columns("E[S], %", 100 * one["mean"]),
                **interval_columns("E[S log p], %", 100 * one["log"]),
                "error of the score, %": 100 * one["score_error"],
            }
            for one in found.to_dict("records")
        )
        even = _even(found)
        exact, probes = even.iloc[0], pd.DataFrame(rows[SCORES]["probes"].iloc[0])
        fields = pd.DataFrame(
            {
                "test field": probes["form"],
                "radius, U": probes["radius"],
                "identity, %": 100 * exact["signals"].mean(axis=0),
                "std. error, %": 100 * exact["errors"].mean(axis=0),
                **{
                    f"{score}, %": 100 * residuals.mean(axis=0)
                    for score, residuals in zip(even["score"], even["residuals"], strict=True)
                },
            }
        )
        return [
            Exhibit("stein_scores", SCORES_CAPTION, scores),
            Exhibit("stein_test_fields", PROBES_CAPTION, fields),
        ]

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        cloud, _ = make_cloud(self.cloud, SAMPLING, self.seeds[0])
        probes = rows[SCORES]["probes"].iloc[0]
        figure = stein_figure(cloud.normalize(cloud.points), probes, _even(findings(rows)))
        return [Exhibit("stein", FIGURE_CAPTION, figure)]


def measure_stein(trial: SteinTrial, folder: Path) -> Row:
    """Trains a score, if it is a learned one, and measures how it keeps the identity.

    Returns:
        `probes`: form, radius and centre of each test field; and `found`: what
        `Moments.departures` says of the score, and of the exact one also squashed, as it is
        and rescaled, by their names.
    """
    cloud, _ = make_cloud(trial.cloud, trial.sampling, trial.seed)
    score: ScoreNetwork | GaussianMixture
    if trial.score == EXACT:
        score = mixture = GaussianMixture(cloud.normalize(cloud.points), SIGMA)
    else:
        # The tangent is not asked for.
        options: dict[str, Any] = {"tangent_iterations": 1, "max_restarts": 0}
        learned = trained(cloud, trial.score, trial.seed, **options).guiding_field
        points = cloud.points if learned.support is None else learned.support
        mixture = GaussianMixture(cloud.normalize(points), learned.sigma)
        score = learned.score_model
    probes = make_probes(mixture.points)
    moments = collect(score, mixture, probes, trial.draws, trial.seed)
    found = {RECIPE_NAMES.get(trial.score, trial.score): moments.departures()}
    if trial.score == EXACT:
        found[SQUASHED_NAME] = moments.departures(SQUASHED)
        found[RESCALED_NAME] = moments.departures(SQUASHED, moments.best_scale())
    return {"probes": [vars(probe) for probe in probes], "found": found}


# What the seeds say together.


def findings(rows: Rows) -> pd.DataFrame:
    """Returns what the seeds say of each score on each density, in the order of the trials.

    Returns:
        The `density` and the `score` in words, and what `Moments.departures` has: residuals,
        errors and signals (seeds, K), mean and log (seeds,), the root mean square curve, the
        largest z and the means of the rest over the seeds.  Besides, the `slope`, the
        exponent with which the residual falls with the draws; and the `share`, the residual
        over what the identity says, root mean square over the test fields.
    """
    table = pd.DataFrame(
        {"density": f"{trial['cloud']}, {trial['sampling']}", "score": name, **found}
        for trial in rows[SCORES].to_dict("records")
        for name, found in trial["found"].items()
    )
    return over_seeds(table, ("density", "score"), _over_seeds)


def _rms(values: FloatArray, axis: int | None = None) -> FloatArray:
    return np.sqrt((values**2).mean(axis=axis))


def _over_seeds(own: pd.DataFrame) -> Row:
    residuals, errors, signals, curves = (
        np.array(own[name].tolist()) for name in ("residuals", "errors", "signals", "curve")
    )
    draws, curve = np.array(own["draws"].iloc[0]), _rms(curves, axis=0)
    # The square of a mean of draws exceeds that of the expectation by the square of its
    # standard error on average.
    square = max(float((residuals**2 - errors**2).mean()), 0.0)
    return {
        **{"residuals": residuals, "errors": errors, "signals": signals},
        **{name: own[name].to_numpy() for name in ("mean", "log")},
        **{name: own[name].max() for name in ("z", "mean_z", "log_z")},
        **{name: own[name].mean() for name in ("score_error", "scale")},
        **{"draws": draws, "curve": curve},
        # All draws are a single sample, whose residual says little of its root mean square.
        "slope": np.polyfit(np.log(draws[:-1]), np.log(curve[:-1]), 1)[0],
        "share": np.sqrt(square) / _rms(signals),
    }


def _even(found: pd.DataFrame) -> pd.DataFrame:
    """Returns the findings on the first density, that of the even waypoints."""
    return found[found["density"] == found["density"].iloc[0]]


# Claims.

CLAIMS = Claims()
Z = "largest entry, standard errors"
SHARE_LEFT = "residual, of what the identity says"


def z_limit(count: int) -> float:
    """Returns the z that the largest of `count` entries passes by chance in `SIGNIFICANCE`.

    By Bonferroni's bound, whatever their correlation.
    """
    return float(stats.norm.isf(SIGNIFICANCE / 2 / count))


def _of(rows: Rows, score: str) -> pd.DataFrame:
    found = findings(rows)
    return found[found["score"] == score]


def _entries(found: pd.DataFrame) -> int:
    return ENTRIES * sum(residuals.size for residuals in found["residuals"])


@CLAIMS.add("stein-identity", SECTION)
def _identity(rows: Rows) -> Judged:
    """E[S f^T] = -E[grad f] for smooth f of compact support."""
    exact = _of(rows, EXACT)
    entries, z, slopes = _entries(exact), float(exact["z"].max()), Span.of(exact["slope"])
    limit = z_limit(entries)
    falls = all(abs(slope - SLOPE) <= SLOPE_TOLERANCE for slope in (slopes.low, slopes.high))
    return {
        "entries": entries,
        Z: z,
        "limit": limit,
        "power of the draws": slopes,
    }, Verdict.when(z <= limit and falls)


@CLAIMS.add("stein-log-density", SECTION)
def _log_density(rows: Rows) -> Judged:
    """E[S log p] = 0, and E[S] = 0."""
    exact = _of(rows, EXACT)
    z = float(exact[["log_z", "mean_z"]].max().max())
    # Two coordinates each of E[S log p] and E[S].
    limit = z_limit(4 * sum(map(len, exact["log"])))
    return {
        Z: z,
        "limit": limit,
        "E[S log p] at most, %": float(100 * exact["log"].map(max).max()),
    }, Verdict.when(z <= limit)


def _learned(rows: Rows, recipe: str) -> Judged:
    learned = _of(rows, RECIPE_NAMES[recipe])
    (one,) = learned.to_dict("records")
    limit = z_limit(_entries(learned))
    return {
        SHARE_LEFT: Share(one["share"]),
        Z: float(one["z"]),
        "limit": limit,
        "E[S], %": float(100 * one["mean"].mean()),
        "error of the score": Share(one["score_error"]),
    }, Verdict.when(one["z"] <= limit, one["share"] <= PART)


@CLAIMS.add("stein-squashed-identity", NORMALISED)
def _squashed(rows: Rows) -> Judged:
    """The normalised score s = tanh(k_s |S|) S / |S| does not satisfy the identity."""
    squashed, rescaled = _of(rows, SQUASHED_NAME), _of(rows, RESCALED_NAME)
    z, limit = float(squashed["z"].min()), z_limit(_entries(squashed))
    figures: dict[str, Any] = {
        SHARE_LEFT: Share(squashed["share"].iloc[0]),
        Z: z,
        "limit": limit,
        "best factor": float(rescaled["scale"].iloc[0]),
        "limit after it": z_limit(_entries(rescaled)),
    }
    for one in rescaled.to_dict("records"):
        figures[f"{Z}, after it on {one['density']}"] = float(one["z"])
        figures[f"residual, %, after it on {one['density']}"] = float(100 * one["share"])
    return figures, Verdict.when(z > limit)


@CLAIMS.add("stein-squashed-mean", NORMALISED)
def _squashed_mean(rows: Rows) -> Judged:
    """The normalised score does not have mean zero."""
    squashed = _of(rows, SQUASHED_NAME)
    strongest = squashed.nlargest(1, "mean_z").iloc[0]
    z, limit = float(strongest["mean_z"]), z_limit(2 * sum(map(len, squashed["mean"])))
    return {
        "density": strongest["density"],
        Z: z,
        "limit": limit,
        "mean, %": float(100 * strongest["mean"].mean()),
    }, Verdict.when(z > limit)


# The figure.


def stein_figure(points: FloatArray, probes: Sequence[Row], found: pd.DataFrame) -> Figure:
    """Returns the test fields, the residual over the draws, and that of each test field.

    Args:
        points: The waypoints, (N, 2) in U.
        probes: Form, radius and centre of each test field, in U.
        found: The `findings` on one density, the exact score first.
    """
    figure, axes = plotting.new_figure(1, 3, 14, 4.6)
    # Not to scale: the squashed score is shown rescaled alone.
    scores = found[found["score"] != SQUASHED_NAME].to_dict("records")
    _plot_supports(axes[0], points, probes)
    _plot_convergence(axes[1], scores)
    _plot_residuals(axes[2], probes, scores)
    plotting.legend_below(figure, *axes[1].get_legend_handles_labels())
    return figure


def _plot_supports(axes: Axes, points: FloatArray, probes: Sequence[Row]) -> None:
    plotting.plot_waypoints(axes, points)
    places = {(*probe["centre"], probe["radius"]) for probe in probes}
    for x, y, radius in places:
        axes.add_patch(Circle((x, y), radius, color=plotting.ORANGE, alpha=0.2, linewidth=0))
        axes.add_patch(Circle((x, y), radius, fill=False, color=plotting.ORANGE))
    reach = 1.05 * max(max(abs(x), abs(y)) + radius for x, y, radius in places)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    plotting.plane_axes(axes, "U", "waypoints and supports of f")


def _plot_convergence(axes: Axes, scores: Sequence[Mapping[Any, Any]]) -> None:
    for one, (color, marker) in zip(scores, STYLES, strict=False):
        style = {"marker": marker, "markersize": 4, "color": color, "label": one["score"]}
        axes.plot(one["draws"], 100 * one["curve"], **style)
    draws, curve = scores[0]["draws"], scores[0]["curve"]
    root = 100 * curve[0] * np.sqrt(draws[0] / draws)
    axes.plot(draws, root, color=plotting.GREY, linestyle="--", label=r"$\propto 1/\sqrt{n}$")
    axes.set(
        xlabel="draws n",
        ylabel="residual [% of bound]",
        xscale="log",
        yscale="log",
        title="residual over the draws",
    )
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)


def _plot_residuals(
    axes: Axes, probes: Sequence[Row], scores: Sequence[Mapping[Any, Any]]
) -> None:
    places = np.arange(len(probes))
    axes.barh(places, 100 * scores[0]["signals"].mean(axis=0), color="#d9d9d9", height=0.8)
    for one, (color, marker) in zip(scores, STYLES, strict=False):
        residuals = 100 * one["residuals"].mean(axis=0)
        axes.plot(residuals, places, marker, markersize=5, color=color)
    axes.set_yticks(places, [f"{probe['form']}, R = {probe['radius']:g}" for probe in probes])
    axes.invert_yaxis()
    axes.set(
        xlabel="residual [% of bound]",
        xscale="log",
        xlim=(0.03, None),
        title="grey: what the identity says",
    )
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3, axis="x")
