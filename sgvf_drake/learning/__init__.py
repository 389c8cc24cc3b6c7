"""Training: from a point cloud to a guiding field.  The only package that needs torch."""

from sgvf_drake.learning.config import RECIPES, TrainingConfig
from sgvf_drake.learning.self_check import SelfCheck, check_field
from sgvf_drake.learning.training import TrainingResult, train

__all__ = [
    "RECIPES",
    "SelfCheck",
    "TrainingConfig",
    "TrainingResult",
    "check_field",
    "train",
]
