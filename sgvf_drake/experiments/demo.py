"""The main job from end to end: the paper's first flight scenario."""

from os import PathLike
from typing import Any

import pandas as pd

from sgvf_drake.experiments.results import SUMMARY, result_folder, write_summary
from sgvf_drake.experiments.runs import open_field, run_fly, run_follow, run_train
from sgvf_drake.paths import make_shape
from sgvf_drake.progress import Progress, no_progress

SHAPE = "concentric-flight"
STARTS = 100
# The speed of the paper's flights, m/s.
SPEED = 0.45
PARTS = ("train", "follow", "fly")


def run_demo(
    out: str | PathLike[str], *, overwrite: bool = False, progress: Progress = no_progress
) -> dict[str, Any]:
    """Trains on the concentric rings, follows them from a grid, and flies each of them.

    Args:
        out: The folder of the results; one folder in it for each part.
        overwrite: Whether results there may be replaced.
        progress: Told how far each part is.

    Returns:
        The summaries of the parts by name.
    """
    from sgvf_drake.learning import TrainingConfig

    with result_folder(out, (SUMMARY, "waypoints.csv", *PARTS), overwrite=overwrite) as folder:
        cloud, _ = make_shape(SHAPE)
        waypoints = pd.DataFrame(cloud.points, columns=["x", "y"])
        waypoints.to_csv(folder / "waypoints.csv", index=False)
        train = run_train(cloud, TrainingConfig(), folder / "train", progress=progress)
        field = open_field(folder / "train")
        follow = run_follow(field, None, folder / "follow", starts=STARTS, progress=progress)
        flight = run_fly(field, None, folder / "fly", speed=SPEED, progress=progress)
        summary = {"train": train, "follow": follow, "fly": flight}
        write_summary(folder, summary)
    return summary
