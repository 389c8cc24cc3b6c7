"""What a training run is asked to do: the recipe, and what the user overrides of it."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
import math
import operator
from typing import Any, Literal, get_args

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning.scales import SIGMA_DEFAULT, CloudScales

Recipe = Literal["paper", "robust", "exact"]
RECIPES: tuple[Recipe, ...] = get_args(Recipe)
# k_s of the robust composition, in noise levels; it is the paper's 0.2 at a sigma of 0.1.
GAIN_PER_SIGMA = 2.0
# Of the robust recipe at the default noise level; a finer level takes more of each.
FREQUENCY_STD = 2.0
SCORE_ITERATIONS = 1_500
TANGENT_ITERATIONS = 1_200


@dataclass(frozen=True)
class TrainingConfig:
    """A training run.  What is None follows from the recipe and the cloud.

    Attributes:
        recipe: `paper` (Algorithms 1 and 2 to the letter), `robust` (the default), or
            `exact` (the closed-form score of the Gaussian mixture in place of a network).
        seed: Of every random number of the run; the same seed gives the same field on the
            same machine.
        max_restarts: How often a field that fails its self-check is trained again with
            another seed.
        sigma_min: Noise level at the data end, normalised units (half-extent 4).
        gain: k_s of the normalised score, normalised units; None: the paper's 0.2, or 2 sigma
            in the other recipes, which makes half a noise level the distance over which the
            robot turns from approaching the path to following it.
        frequency_std: Standard deviation of the random Fourier frequencies.
        score_hidden: Hidden widths of the score network.
        score_iterations: Optimisation steps of the score network.
        tangent_hidden: Hidden widths of the tangent network.
        tangent_iterations: Optimisation steps of the tangent network.

    Raises:
        ConfigurationError: A value cannot be used; the message names it.
    """

    recipe: Recipe = "robust"
    seed: int = 0
    max_restarts: int | None = None
    sigma_min: float | None = None
    gain: float | None = None
    frequency_std: float | None = None
    score_hidden: tuple[int, ...] | None = None
    score_iterations: int | None = None
    tangent_hidden: tuple[int, ...] | None = None
    tangent_iterations: int | None = None

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ConfigurationError(
                f"unknown recipe {self.recipe!r}; choose one of {', '.join(RECIPES)}"
            )
        for name, convert in _CONVERT.items():
            value = getattr(self, name)
            if value is None and name != "seed":
                continue
            try:
                # Plain Python values, also from NumPy's: they are written as JSON.
                object.__setattr__(self, name, convert(value))
            except (TypeError, ValueError, OverflowError):
                raise ConfigurationError(f"{name} cannot be {value!r}") from None

    def resolved(self, scales: CloudScales) -> "Settings":
        """Returns every value of the run, for a cloud of these scales."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        defaults = _PAPER if self.recipe == "paper" else _ROBUST
        values = {"sigma_min": scales.sigma_min, **defaults, **given}
        values.setdefault("gain", GAIN_PER_SIGMA * values["sigma_min"])
        # A finer level has more to learn: features of more detail, in more iterations.
        detail = max(1.0, SIGMA_DEFAULT / values["sigma_min"])
        values.setdefault("frequency_std", FREQUENCY_STD * detail)
        values.setdefault("score_iterations", round(SCORE_ITERATIONS * detail))
        values.setdefault("tangent_iterations", round(TANGENT_ITERATIONS * detail))
        return Settings(**values)


@dataclass(frozen=True)
class Settings:
    """A `TrainingConfig` with every value filled in; the names mean the same."""

    recipe: Recipe
    seed: int
    max_restarts: int
    sigma_min: float
    gain: float
    frequency_std: float
    score_hidden: tuple[int, ...]
    score_iterations: int
    tangent_hidden: tuple[int, ...]
    tangent_iterations: int


def _natural(value: Any) -> int:
    number = int(operator.index(value))
    if number < 0:
        raise ValueError
    return number


def _count(value: Any) -> int:
    number = _natural(value)
    if number == 0:
        raise ValueError
    return number


def _positive(value: Any) -> float:
    if not (math.isfinite(value) and value > 0):
        raise ValueError
    return float(value)


def _widths(value: Any) -> tuple[int, ...]:
    if len(value) == 0:
        raise ValueError
    return tuple(_count(width) for width in value)


_CONVERT: dict[str, Callable[[Any], Any]] = {
    "seed": _natural,
    "max_restarts": _natural,
    "sigma_min": _positive,
    "gain": _positive,
    "frequency_std": _positive,
    "score_hidden": _widths,
    "score_iterations": _count,
    "tangent_hidden": _widths,
    "tangent_iterations": _count,
}
# Paper, Section V-A: networks, iterations and k_s.  No restarts: it is there to be compared.
_PAPER: dict[str, Any] = {
    "max_restarts": 0,
    "sigma_min": 0.1,
    "gain": 0.2,
    "frequency_std": 0.0,
    "score_hidden": (64, 64, 64, 64),
    "score_iterations": 10_000,
    "tangent_hidden": (128,),
    "tangent_iterations": 10_000,
}
# The exact recipe shares them; it has no score network.
_ROBUST: dict[str, Any] = {
    "max_restarts": 2,
    "score_hidden": (64, 64, 64, 64),
    "tangent_hidden": (64, 64, 64),
}
