"""What a training run is asked to do: the recipe, and what the user overrides of it."""

from dataclasses import asdict, dataclass
import math
from typing import Any, Literal, get_args

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning.scales import CloudScales

Recipe = Literal["paper", "robust", "exact"]
RECIPES: tuple[Recipe, ...] = get_args(Recipe)
# k_s of the robust composition, in noise levels; it is the paper's 0.2 at a sigma of 0.1.
GAIN_PER_SIGMA = 2.0


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
    score_hidden: tuple[int, ...] | None = None
    score_iterations: int | None = None
    tangent_hidden: tuple[int, ...] | None = None
    tangent_iterations: int | None = None

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ConfigurationError(
                f"unknown recipe {self.recipe!r}; choose one of {', '.join(RECIPES)}"
            )
        for name in ("seed", "max_restarts"):
            _check(name, getattr(self, name), lambda value: int(value) == value >= 0)
        for name in ("sigma_min", "gain"):
            _check(name, getattr(self, name), lambda value: math.isfinite(value) and value > 0)
        for name in ("score_iterations", "tangent_iterations"):
            _check(name, getattr(self, name), lambda value: int(value) == value >= 1)
        for name in ("score_hidden", "tangent_hidden"):
            _check(name, getattr(self, name), lambda value: value and min(value) >= 1)

    def resolved(self, scales: CloudScales) -> "Settings":
        """Returns every value of the run, for a cloud of these scales."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        defaults = _PAPER if self.recipe == "paper" else _ROBUST
        values = {"sigma_min": scales.sigma_min, **defaults, **given}
        values.setdefault("gain", GAIN_PER_SIGMA * values["sigma_min"])
        return Settings(**values)


@dataclass(frozen=True)
class Settings:
    """A `TrainingConfig` with every value filled in; the names mean the same."""

    recipe: Recipe
    seed: int
    max_restarts: int
    sigma_min: float
    gain: float
    score_hidden: tuple[int, ...]
    score_iterations: int
    tangent_hidden: tuple[int, ...]
    tangent_iterations: int


def _check(name: str, value: Any, is_valid: Any) -> None:
    try:
        valid = value is None or bool(is_valid(value))
    except (TypeError, ValueError, OverflowError):
        valid = False
    if not valid:
        raise ConfigurationError(f"{name} cannot be {value!r}")


# Paper, Section V-A: networks, iterations and k_s.  No restarts: it is there to be compared.
_PAPER: dict[str, Any] = {
    "max_restarts": 0,
    "sigma_min": 0.1,
    "gain": 0.2,
    "score_hidden": (64, 64, 64, 64),
    "score_iterations": 10_000,
    "tangent_hidden": (128,),
    "tangent_iterations": 10_000,
}
# The exact recipe shares them; it has no score network.
_ROBUST: dict[str, Any] = {
    "max_restarts": 2,
    "score_hidden": (64, 64, 64, 64),
    "score_iterations": 1_500,
    "tangent_hidden": (64, 64, 64),
    "tangent_iterations": 1_200,
}
