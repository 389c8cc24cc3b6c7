"""Score-induced guiding vector fields: follow a path that exists only as a cloud of points.

    import sgvf_drake as sgvf

    cloud = sgvf.PointCloud.read("waypoints.csv")
    field = sgvf.train(cloud).field
    field.save("field.safetensors")

Loading and evaluating a field needs NumPy alone; torch is imported by the first use of
`train` and its kin.
"""

from typing import TYPE_CHECKING, Any

from sgvf_drake.exceptions import (
    ConfigurationError,
    FieldFileError,
    NonFiniteValueError,
    OutputExistsError,
    PointCloudError,
    SgvfError,
)
from sgvf_drake.fields import Field, GaussianMixture, GuidingField, load_field
from sgvf_drake.paths import SHAPES, PointCloud, ReferencePath, make_shape, shape_path

if TYPE_CHECKING:
    from sgvf_drake.learning import SelfCheck, TrainingConfig, TrainingResult, train

__version__ = "0.1.0"

_LEARNING = ("SelfCheck", "TrainingConfig", "TrainingResult", "train")

__all__ = [
    "SHAPES",
    "ConfigurationError",
    "Field",
    "FieldFileError",
    "GaussianMixture",
    "GuidingField",
    "NonFiniteValueError",
    "OutputExistsError",
    "PointCloud",
    "PointCloudError",
    "ReferencePath",
    "SelfCheck",
    "SgvfError",
    "TrainingConfig",
    "TrainingResult",
    "load_field",
    "make_shape",
    "shape_path",
    "train",
]


def __getattr__(name: str) -> Any:
    if name in _LEARNING:
        from sgvf_drake import learning

        return getattr(learning, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
