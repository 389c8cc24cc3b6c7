"""Against what a field is measured: a file, the true shape, or what was found."""

from collections.abc import Sequence
from pathlib import Path

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import DirectedField, GuidingField
from sgvf_drake.paths import ReferencePath


def choose_reference(
    field: GuidingField | DirectedField,
    file: str | Path | None = None,
    columns: Sequence[str | int] | None = None,
    *,
    closed: bool | None = None,
) -> tuple[ReferencePath, str]:
    """Returns the best reference there is for a field, and its kind.

    Args:
        field: The field to be measured.
        file: An ordered polyline in the field's unit; it comes first where given.
        columns: Which columns of the file hold the coordinates.
        closed: Whether the file's polyline is closed; None: if its last point repeats its
            first.

    Returns:
        The reference and `file`, `shape` (the field was trained on a named shape), `cloud`
        (the paths that were found in the waypoints) or `network` (of a directed field).

    Raises:
        PointCloudError: If the file cannot be read.
        ConfigurationError: If the file has another dimension than the field, or is in
            degrees and the field's waypoints were not; or if it is given for a directed field.
    """
    if isinstance(field, DirectedField):
        if file is not None:
            raise ConfigurationError(
                f"{file}: a field of paths that cross or branch is measured against its own "
                "network, not a reference"
            )
        return field.network.path, "network"
    if file is not None:
        origin = field.cloud.origin
        path = ReferencePath.read(file, columns, closed, origin)
        if path.origin != origin and path.origin is not None:
            raise ConfigurationError(
                f"{file}: the reference is in degrees, but the field's waypoints were not"
            )
        if path.dim != field.dim:
            raise ConfigurationError(
                f"{file}: the reference has {path.dim} coordinates, the field {field.dim}"
            )
        return path, "file"
    return field.path, "cloud" if field.cloud.shape is None else "shape"
