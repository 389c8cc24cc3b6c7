"""Cases, each one training and what names it; and suites of them, from few to all."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
import hashlib
from pathlib import Path
import re
from typing import Any

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import clouds
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.paths import SHAPES

# Starts of a case, unless given.
STARTS = 100

# The columns by which a table is sorted; all but the seed make a group.
LABELS = ("name", "shape", "sampling", "recipe", "seed")

HEADLINE = ("concentric-circles", "separated-circles")
# Shapes of the size for which a noise of 0.05 is meant.
LARGE_SHAPES = (*HEADLINE, "circle", "square", "hexagon", "octagon", "triangle", "star")
# Seeds of hard clouds, unless given.
ROBUSTNESS_SEEDS = 3


@dataclass(frozen=True)
class Case:
    """One training and what it is measured with.

    Attributes:
        name: The group of cases it belongs to.
        cloud: Path of the cloud, one of `clouds.PATHS`; with a source, a name for it.
        sampling: One of `clouds.SAMPLINGS`.
        recipe: The recipe of the training.
        seed: Seed of the cloud and of the training.
        starts: Number of starts on a grid over the box.
        overrides: Names and values of a `TrainingConfig`, beside recipe and seed.
        source: A file with the ordered path.
        digest: Of the content of that file, without which another one would be the same case.
    """

    name: str
    cloud: str
    sampling: str = "uniform"
    recipe: str = "robust"
    seed: int = 0
    starts: int = STARTS
    overrides: tuple[tuple[str, Any], ...] = ()
    source: str | None = None
    digest: str | None = None

    @property
    def key(self) -> str:
        """The stem of its files; it leaves out starts, overrides and source."""
        raw = "-".join([self.name, self.cloud, self.sampling, self.recipe, f"seed{self.seed}"])
        safe = re.sub(r"[^A-Za-z0-9_.-]", "_", raw)
        if safe == raw:
            return raw
        return f"{safe}-{hashlib.sha256(raw.encode()).hexdigest()[:8]}"

    @property
    def labels(self) -> dict[str, Any]:
        """Its columns of the table: `LABELS`, starts and key."""
        return {
            "name": self.name,
            "shape": self.cloud,
            "sampling": self.sampling,
            "recipe": self.recipe,
            "seed": self.seed,
            "starts": self.starts,
            "key": self.key,
        }


class Suite(StrEnum):
    """The suites, as the command line offers them."""

    SMALL = "small"
    CLOSED = "closed"
    ROBUSTNESS = "robustness"
    RECIPES = "recipes"
    HANDWRITING = "handwriting"
    FULL = "full"


def suite_cases(
    suite: Suite,
    seeds: int | None = None,
    starts: int | None = None,
    circuits: Path | None = None,
) -> list[Case]:
    """Returns the cases of a suite.

    Args:
        suite: small (a minute or two), closed (every named shape), robustness (hard clouds,
            and the recipes side by side), recipes, handwriting, or full (all of them but
            small).
        seeds: Number of seeds, from 0; None: the suite's own.
        starts: Number of starts; None: the suite's own.
        circuits: A folder; every .csv file in it is an ordered path and becomes a case.

    Raises:
        ConfigurationError: If a number is not positive, or the folder holds no .csv file.
    """
    for name, number in (("seeds", seeds), ("starts", starts)):
        if number is not None and number < 1:
            raise ConfigurationError(f"the number of {name} must be at least 1, not {number}")
    cases = [
        Case(part.name, *cloud, recipe, seed, starts or part.starts, part.overrides)
        for part in _SUITES[suite]
        for seed in range(seeds or part.seeds)
        for cloud in part.clouds
        for recipe in part.recipes
    ]
    if circuits is not None:
        own = range(seeds or ROBUSTNESS_SEEDS)
        cases += _file_cases(circuits, own, starts or STARTS)
    return cases


def _file_cases(folder: Path, seeds: Iterable[int], starts: int) -> list[Case]:
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ConfigurationError(f"{folder} holds no .csv file")
    digests = {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return [
        Case(
            "circuits",
            file.stem,
            "recorded",
            seed=seed,
            starts=starts,
            source=str(file),
            digest=digest,
        )
        for seed in seeds
        for file, digest in digests.items()
    ]


@dataclass(frozen=True)
class _Part:
    """Cases of one name, each recipe on each cloud, for some seeds from 0 on."""

    name: str
    clouds: tuple[tuple[str, str], ...]
    recipes: tuple[str, ...] = ("robust",)
    seeds: int = 1
    starts: int = STARTS
    overrides: tuple[tuple[str, Any], ...] = ()


def _sampled(sampling: str, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
    return tuple((name, sampling) for name in names)


_SMALL = _Part(
    "small",
    (
        *_sampled("uniform", ("concentric-circles", "separated-circles", "square", "star")),
        *(("circle", "forty"), ("star", "random-noisy"), ("hairpin", "uniform")),
    ),
)
_CLOSED = _Part("closed", _sampled("uniform", SHAPES), seeds=5, starts=400)
_ROBUSTNESS = _Part(
    "robustness",
    (
        *_sampled("forty", LARGE_SHAPES),
        *_sampled("random-noisy", SHAPES),
        ("circle", "uneven"),
        *_sampled("duplicates", ("concentric-circles", "square")),
        *_sampled("outliers", ("concentric-circles", "square")),
        ("concentric-circles", "dense"),
        *_sampled("uniform", ("millimetres", "kilometres")),
        *_sampled("uniform", ("two-sizes", "near-touch", "hairpin")),
        *_sampled("fine", clouds.CIRCUITS),
    ),
    seeds=ROBUSTNESS_SEEDS,
)
_RECIPES = _Part("recipes", _sampled("uniform", HEADLINE), tuple(RECIPES), ROBUSTNESS_SEEDS)
_HANDWRITING = _Part(
    "handwriting", _sampled("recorded", clouds.HANDWRITING), overrides=(("open", True),)
)
_SUITES: dict[Suite, tuple[_Part, ...]] = {
    Suite.SMALL: (_SMALL,),
    Suite.CLOSED: (_CLOSED,),
    Suite.ROBUSTNESS: (_ROBUSTNESS, _RECIPES),
    Suite.RECIPES: (_RECIPES,),
    Suite.HANDWRITING: (_HANDWRITING,),
    Suite.FULL: (_CLOSED, _ROBUSTNESS, _RECIPES, _HANDWRITING),
}
