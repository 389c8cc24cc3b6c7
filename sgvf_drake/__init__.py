"""Score-induced guiding vector fields: follow a path that exists only as a cloud of points.

    import sgvf_drake as sgvf

    cloud = sgvf.PointCloud.read("waypoints.csv")
    field = sgvf.train(cloud).field
    field.save("field.safetensors")

Loading and evaluating a field needs NumPy alone; torch is imported by the first use of
`train` and its kin, the verification by that of `verify` or `certify`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import (
    ConfigurationError,
    FieldFileError,
    NonFiniteValueError,
    OutputExistsError,
    PointCloudError,
    SgvfError,
)
from sgvf_drake.fields import (
    DirectedField,
    Field,
    GaussianMixture,
    GuidingField,
    load_field,
)
from sgvf_drake.paths import SHAPES, PathNetwork, ReferencePath, make_shape, shape_path

if TYPE_CHECKING:
    from sgvf_drake.certificate import (
        Certificate,
        NetworkCertificate,
        certify,
        certify_network,
        enclose_zeros,
    )
    from sgvf_drake.learning import SelfCheck, TrainingConfig, TrainingResult, train
    from sgvf_drake.lyapunov import LyapunovFunction, find_singularities, verify
    from sgvf_drake.paths.finding import find_paths

__version__ = "0.1.0.dev0"

# What is imported on its first use, and from where.
_LATER = {
    "find_paths": "paths.finding",
    **dict.fromkeys(("SelfCheck", "TrainingConfig", "TrainingResult", "train"), "learning"),
    **dict.fromkeys(("LyapunovFunction", "find_singularities", "verify"), "lyapunov"),
    **dict.fromkeys(
        ("Certificate", "NetworkCertificate", "certify", "certify_network", "enclose_zeros"),
        "certificate",
    ),
}

__all__ = [
    "SHAPES",
    "Certificate",
    "ConfigurationError",
    "DirectedField",
    "Field",
    "FieldFileError",
    "GaussianMixture",
    "GuidingField",
    "LyapunovFunction",
    "NetworkCertificate",
    "NonFiniteValueError",
    "OutputExistsError",
    "PathNetwork",
    "PointCloud",
    "PointCloudError",
    "ReferencePath",
    "SelfCheck",
    "SgvfError",
    "TrainingConfig",
    "TrainingResult",
    "certify",
    "certify_network",
    "enclose_zeros",
    "find_paths",
    "find_singularities",
    "load_field",
    "make_shape",
    "shape_path",
    "train",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(import_module(f"sgvf_drake.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
