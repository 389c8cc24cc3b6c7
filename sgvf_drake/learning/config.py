"""What a training run is asked to do: the recipe, and what the user overrides of it."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
import math
import operator
from typing import Any

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.learning.support import SIGMA_DEFAULT
from sgvf_drake.paths.draft import DIRECTIONS, Direction

# k_s of the robust composition, in noise levels; it is the paper's 0.2 at a sigma of 0.1.
GAIN_PER_SIGMA = 2.0
# Of the robust recipe at the default noise level; a finer level takes more of each.
FREQUENCY_STD = 2.0
# Of a directed field, whose one network has all of the detail: .24 radians a noise level.
STRAND_FREQUENCY_STD = 6.0
SCORE_ITERATIONS = 1_500
TANGENT_ITERATIONS = 1_000
# Each restart adds this share of the first attempt's widths and iterations.
GROWTH = 0.5


@dataclass(frozen=True)
class TrainingConfig:
    """A training run.  What is None follows from the recipe and the cloud.

    Attributes:
        recipe: `paper` (Algorithms 1 and 2 to the letter), `robust` (the default), or
            `exact` (the closed-form score of the Gaussian mixture in place of a network).
        seed: Of every random number of the run; the same seed gives the same field on the
            same machine.
        open: Whether the pieces are open paths, at whose ends robots come to rest; None:
            what the cloud looks like.
        passes: Whether all waypoints are passes of one path, whose spread is scatter.
        direction: `ccw` or `cw` (closed pieces in the plane) or `reverse` (of the rule), for
            all pieces or a tuple with one for each (None: the rule), the longest first; the
            rule is that of `find_paths`.
        start: A point near which open paths start, (d,) in the unit of the waypoints.
        anyway: Whether to train also on paths that branch or cross, which no field of the
            position alone can follow everywhere.
        max_restarts: How often a field that fails its self-check is trained again with
            another seed.
        sigma_min: Noise level at the data end, normalised units (half-extent 4).
        gain: k_s of the normalised score, normalised units; None: the paper's 0.2, or 2 sigma
            in the other recipes, which makes half a noise level the distance over which the
            robot turns from approaching the path to following it.
        frequency_std: Standard deviation of the random Fourier frequencies.
        num_frequencies: Random Fourier features that each network sees; 0: none, the networks
            see the scaled inputs themselves.
        exact_target: Whether the score learns the exact score of the noised waypoints; else
            Algorithm 1's noisy target -eps / sigma(t) of the waypoint that was drawn.  In the
            robust recipe all samples are then drawn by the perturbation, none in the box.
        score_hidden: Hidden widths of the score network.
        score_iterations: Optimisation steps of the score network.
        tangent_hidden: Hidden widths of the tangent network.
        tangent_iterations: Optimisation steps of the tangent network.
        unit_weight: lambda_1 of the paper, the weight of the unit-length loss; 0 removes a
            loss.
        orthogonality_weight: lambda_2, of the orthogonality loss.
        direction_weight: lambda_3, of the directional consistency loss.
        hint_weight: Of the agreement with the orientation hint.  At 0 nothing decides which
            way along a piece, and a piece may get both.
        projection: Whether the score's part along the tangent is taken out near the path.

    Raises:
        ConfigurationError: A value cannot be used, or means nothing in the recipe; the message
            names it.
    """

    recipe: str = "robust"
    seed: int = 0
    open: bool | None = None
    passes: bool = False
    direction: Direction | tuple[Direction | None, ...] | None = None
    start: tuple[float, ...] | None = None
    anyway: bool = False
    max_restarts: int | None = None
    sigma_min: float | None = None
    gain: float | None = None
    frequency_std: float | None = None
    num_frequencies: int | None = None
    exact_target: bool | None = None
    score_hidden: tuple[int, ...] | None = None
    score_iterations: int | None = None
    tangent_hidden: tuple[int, ...] | None = None
    tangent_iterations: int | None = None
    unit_weight: float | None = None
    orthogonality_weight: float | None = None
    direction_weight: float | None = None
    hint_weight: float | None = None
    projection: bool | None = None

    def __post_init__(self) -> None:
        if self.recipe not in list(RECIPES):
            raise ConfigurationError(
                f"unknown recipe {self.recipe!r}; choose one of {', '.join(RECIPES)}"
            )
        for name, convert in _CONVERSIONS.items():
            value = getattr(self, name)
            if value is None and name not in ("seed", "passes", "anyway"):
                continue
            try:
                # Plain Python values, also from NumPy's: they are written as JSON.
                object.__setattr__(self, name, convert(value))
            except (TypeError, ValueError, OverflowError):
                raise ConfigurationError(f"{name} cannot be {value!r}") from None
        for name, reason in RECIPES[self.recipe].refused.items():
            if getattr(self, name) is not None:
                raise ConfigurationError(
                    f"{name} is not for the recipe {self.recipe}, {reason}"
                )
        if not any(self.resolved(SIGMA_DEFAULT).weights.values()):
            raise ConfigurationError("every loss of the tangent has weight 0; nothing is left")

    @property
    def of_path(self) -> dict[str, Any]:
        """The options of `find_paths` that are given."""
        given = {
            "closed": None if self.open is None else not self.open,
            "passes": self.passes or None,
            "direction": self.direction,
            "start": self.start,
        }
        return {name: value for name, value in given.items() if value is not None}

    def resolved(self, sigma: float, *, dim: int = 2, directed: bool = False) -> "Settings":
        """Returns every value of the run, where the cloud asks for a noise level.

        Args:
            sigma: The noise level.
            dim: The dimension of the waypoints.
            directed: Whether it is of a directed field.

        Raises:
            ConfigurationError: If a directed field is asked for, and an option means nothing
                there.
        """
        given = {
            name: value
            for name, value in asdict(self).items()
            if value is not None and name not in _OF_THE_PATH
        }
        recipe = RECIPES[self.recipe]
        defaults: Mapping[str, Any] = {
            **recipe.defaults,
            **(recipe.in_space if dim > 2 else {}),
        }
        if directed:
            for name in _OF_THE_POSITION_ALONE & given.keys():
                raise ConfigurationError(
                    f"{name} is not for paths that branch or cross, whose field is learned by "
                    "regression on their strands"
                )
            defaults = recipe.strand_defaults or {}
        values = {"sigma_min": sigma, **defaults, **given}
        values.setdefault("gain", GAIN_PER_SIGMA * values["sigma_min"])
        # A finer level has more to learn: features of more detail, in more iterations.
        detail = max(1.0, SIGMA_DEFAULT / values["sigma_min"])
        std = STRAND_FREQUENCY_STD if directed else FREQUENCY_STD
        values.setdefault("frequency_std", std * detail)
        # A score has as much more of it in space, where its network is larger besides.
        wide = dim / 2
        values.setdefault("score_iterations", round(SCORE_ITERATIONS * detail * wide))
        values.setdefault("tangent_iterations", round(TANGENT_ITERATIONS * detail))
        return Settings(**values)


@dataclass(frozen=True)
class Settings:
    """What is learned with, every value filled in; the names are `TrainingConfig`'s."""

    recipe: str
    seed: int
    max_restarts: int
    sigma_min: float
    gain: float
    frequency_std: float
    num_frequencies: int
    exact_target: bool
    score_hidden: tuple[int, ...]
    score_iterations: int
    tangent_hidden: tuple[int, ...]
    tangent_iterations: int
    unit_weight: float
    orthogonality_weight: float
    direction_weight: float
    hint_weight: float
    projection: bool

    @property
    def weights(self) -> dict[str, float]:
        """The weight of each loss of the tangent."""
        return {
            "unit": self.unit_weight,
            "orthogonality": self.orthogonality_weight,
            "direction": self.direction_weight,
            "hint": self.hint_weight,
        }

    def grown(self, attempt: int) -> "Settings":
        """Returns the settings of a later attempt: wider networks, more iterations."""
        factor = 1 + GROWTH * attempt
        return replace(
            self,
            score_hidden=tuple(round(factor * width) for width in self.score_hidden),
            score_iterations=round(factor * self.score_iterations),
            tangent_hidden=tuple(round(factor * width) for width in self.tangent_hidden),
            tangent_iterations=round(factor * self.tangent_iterations),
        )


# What is asked of the path, and not of the learning.
_OF_THE_PATH = ("open", "passes", "direction", "start", "anyway")
# What a directed field has not: a score network of its own, and losses of the tangent.
_OF_THE_POSITION_ALONE = frozenset(
    {
        "exact_target",
        "score_hidden",
        "score_iterations",
        "unit_weight",
        "orthogonality_weight",
        "direction_weight",
        "hint_weight",
    }
)


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


def _weight(value: Any) -> float:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError
    return float(value)


def _widths(value: Any) -> tuple[int, ...]:
    if len(value) == 0:
        raise ValueError
    return tuple(_count(width) for width in value)


def _point(value: Any) -> tuple[float, ...]:
    point = tuple(float(coordinate) for coordinate in value)
    if not all(map(math.isfinite, point)):
        raise ValueError
    return point


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError
    return value


def _direction(value: Any) -> Any:
    choices = (value,) if isinstance(value, str) else tuple(value)
    if not set(choices) <= {*DIRECTIONS, None}:
        raise ValueError
    return value if isinstance(value, str) else choices


# By the name of the option: its value as a plain Python value, or else a ValueError, TypeError
# or OverflowError.
_CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    "seed": _natural,
    "open": _flag,
    "passes": _flag,
    "anyway": _flag,
    "direction": _direction,
    "start": _point,
    "max_restarts": _natural,
    "sigma_min": _positive,
    "gain": _positive,
    "frequency_std": _positive,
    "num_frequencies": _natural,
    "exact_target": _flag,
    "score_hidden": _widths,
    "score_iterations": _count,
    "tangent_hidden": _widths,
    "tangent_iterations": _count,
    "unit_weight": _weight,
    "orthogonality_weight": _weight,
    "direction_weight": _weight,
    "hint_weight": _weight,
    "projection": _flag,
}
