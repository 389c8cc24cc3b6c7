"""Import of networks that were trained elsewhere, into a folder of results."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.runs import field_figure
from sgvf_drake.experiments.results import SUMMARY, result_folder, save_figure, write_summary
from sgvf_drake.experiments.runs import FIELD_FILE
from sgvf_drake.fields import (
    PAPER_GAIN,
    Perceptron,
    ScoreNetwork,
    import_field,
    recover_waypoints,
)

FIGURE = "field.png"
IMPORT_FILES = (SUMMARY, FIELD_FILE, FIGURE)

Folder = str | PathLike[str]
Pair = tuple[str | None, str | None]


def run_import(
    score: Folder,
    tangent: Folder,
    out: Folder,
    *,
    points: Folder | None = None,
    columns: str | Sequence[str | int] | None = None,
    activations: Pair = (None, None),
    keys: Pair = (None, None),
    gain: float = PAPER_GAIN,
    normalise: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Makes a field of two networks; leaves the field, a figure in the plane, the summary.

    Args:
        score: The file of the score network, of (x, t); see `learning.checkpoints`.
        tangent: The file of the tangent network, of x.
        out: The folder of the results.
        points: The file of the waypoints that they were trained on; None: they are recovered
            from the score, which is then planar and in the unit of the paper's shapes.
        columns: Which columns of the file hold the coordinates.
        activations: Those of the score and of the tangent, by their names in torch; None: the
            file tells it, or there is no hidden layer.
        keys: The entries of the two files that are the state dicts; None: the only one.
        gain: k_s of the normalised score, with the score per unit of the waypoints.
        normalise: Whether the field is brought to length one.
        overwrite: Whether results there may be replaced.

    Raises:
        FieldFileError: If a file holds no such network.
        PointCloudError: If the waypoints cannot be read.
        ConfigurationError: If the parts do not fit together, or the gain is not positive.
    """
    # Imported here: the other experiments do without torch.
    from sgvf_drake.learning.checkpoints import load_checkpoint

    with result_folder(out, IMPORT_FILES, overwrite=overwrite) as folder:
        (of_score, of_tangent), (score_key, tangent_key) = activations, keys
        networks = (
            load_checkpoint(score, "score", key=score_key, activation=of_score),
            load_checkpoint(tangent, "tangent", key=tangent_key, activation=of_tangent),
        )
        cloud, origin = _waypoints(networks[0], points, columns)
        files = {"score": Path(score).name, "tangent": Path(tangent).name}
        field = import_field(*networks, cloud, gain=gain, normalise=normalise, files=files)
        field = replace(field, path_network=field.network)
        field.save(folder / FIELD_FILE)
        if field.dim == 2:
            save_figure(field_figure(field)[0], folder / FIGURE)
        summary = {
            "recipe": field.recipe,
            "seed": field.seed,
            "num_points": cloud.num_points,
            "dim": cloud.dim,
            "unit_length": cloud.unit_length,
            "digest": cloud.digest,
            "sigma": field.sigma,
            "gain": gain,
            "normalised": normalise,
            "files": files,
            "points": origin,
            "messages": list(cloud.messages),
            **_architecture("score", networks[0]),
            **_architecture("tangent", networks[1]),
        }
        write_summary(folder, summary)
    return summary


def _waypoints(
    score: Perceptron, file: Folder | None, columns: str | Sequence[str | int] | None
) -> tuple[PointCloud, str]:
    """Returns the waypoints, and whether they are of a `file`, the `score` or a `box`."""
    dim = score.num_inputs - 1
    if file is not None:
        cloud = PointCloud.read(Path(file), columns)
        if cloud.dim != dim:
            raise ConfigurationError(
                f"{file}: the waypoints have {cloud.dim} coordinates, the score network {dim}"
            )
        return cloud, "file"
    if dim != 2:
        raise ConfigurationError(
            f"waypoints are recovered in the plane only, and the networks are of {dim} "
            "dimensions; give them with --points"
        )
    recovered, origin = recover_waypoints(ScoreNetwork(score, 1.0))
    return PointCloud(recovered), origin


def _architecture(kind: str, network: Perceptron) -> dict[str, Any]:
    widths = [network.num_inputs, *(len(bias) for bias in network.biases)]
    return {f"{kind}_layers": widths, f"{kind}_activation": network.activation.name}
