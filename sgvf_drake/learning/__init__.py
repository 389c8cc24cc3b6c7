"""Training: from a point cloud to a guiding field.  The only package that needs torch.

The configuration and the recipes do without it; it is imported by the first use of `train`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sgvf_drake.learning.config import TrainingConfig
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.learning.self_check import SelfCheck, check_field

if TYPE_CHECKING:
    from sgvf_drake.learning.training import TrainingResult, train

__all__ = [
    "RECIPES",
    "SelfCheck",
    "TrainingConfig",
    "TrainingResult",
    "check_field",
    "train",
]


def __getattr__(name: str) -> Any:
    if name in ("TrainingResult", "train"):
        return getattr(import_module("sgvf_drake.learning.training"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
