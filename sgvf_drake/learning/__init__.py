"""Training: from a point cloud to a guiding field.  The only package that needs torch.

Everything is imported on its first use: the recipes are known without torch, SciPy and numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgvf_drake.learning.config import TrainingConfig
    from sgvf_drake.learning.recipes import RECIPES
    from sgvf_drake.learning.self_check import SelfCheck, check_field
    from sgvf_drake.learning.training import TrainingResult, train

_MODULES = {
    "RECIPES": "recipes",
    "SelfCheck": "self_check",
    "TrainingConfig": "config",
    "TrainingResult": "training",
    "check_field": "self_check",
    "train": "training",
}

__all__ = [
    "RECIPES",
    "SelfCheck",
    "TrainingConfig",
    "TrainingResult",
    "check_field",
    "train",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
