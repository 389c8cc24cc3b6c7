"""What a recipe is: how a field is learned, and everything that depends on which it is."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from sgvf_drake.fields import (
    Composition,
    GaussianMixture,
    Perceptron,
    ScoreNetwork,
    StrandMixture,
    StrandNetwork,
)
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    import pandas as pd

    from sgvf_drake.learning.config import Settings


@dataclass(frozen=True, eq=False)
class Fitted:
    """What an attempt to learn a field of the position alone leaves behind."""

    score_model: ScoreNetwork | GaussianMixture
    tangent_network: Perceptron
    composition: Composition
    histories: "list[pd.DataFrame]"


class Recipe(ABC):
    """One way of learning a field.

    This module and those of the recipes import torch only where something is learned.

    Attributes:
        name: As it is asked for.
        defaults: Values of the options of `TrainingConfig`; others follow from the cloud.
        in_space: Those that are others for a field of the position alone in space.
        strand_defaults: The same for directed fields; None: it learns none.
        refused: Options that mean nothing in it, and why.
        learns_score: Whether it trains a score network.
        uses_paths: Whether it learns from the paths that were found; else from the waypoints
            as they are.
        patience: How many times as long as usual its fields are followed.
    """

    name: ClassVar[str]
    defaults: ClassVar[Mapping[str, Any]]
    in_space: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    strand_defaults: ClassVar[Mapping[str, Any] | None] = None
    refused: ClassVar[Mapping[str, str]] = MappingProxyType({})
    learns_score: ClassVar[bool] = True
    uses_paths: ClassVar[bool] = True
    patience: ClassVar[float] = 1.0

    @abstractmethod
    def fit(
        self,
        points: FloatArray,
        hint: FloatArray,
        settings: "Settings",
        score: ScoreNetwork | None,
        progress: Progress,
    ) -> Fitted:
        """Learns a field of the position alone.

        Args:
            points: What is learned from, (N, d) in normalised units.
            hint: The direction of travel at each, (N, d).
            settings: Those of the attempt.
            score: A score network that was trained before, or None.
            progress: Told how far the training is.
        """

    def fit_strands(
        self, mixture: StrandMixture, settings: "Settings", progress: Progress
    ) -> "tuple[StrandMixture | StrandNetwork, list[pd.DataFrame]]":
        """Learns the strands of a directed field; only with `strand_defaults`."""
        raise NotImplementedError
