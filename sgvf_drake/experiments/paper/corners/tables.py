"""The tables of corners: every field, where agents stall, and where the traps are."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paper.intervals import interval_columns
from sgvf_drake.experiments.paper.corners.traps import Traps, even_share, examine

NETWORKS = ("shallow", "deep", "robust")
# The range of a share in per cent.
PERCENT = (0.0, 100.0)


@dataclass(frozen=True, eq=False)
class CornerField:
    """What was measured of one field.

    Attributes:
        row: See `corners_trials.measure_corners`.
        along: `speed` and `progress` along the sides, (corners, samples).
        traps: Its stable zeros on the polygon.
        folder: Where its files are.
    """

    row: Mapping[str, Any]
    along: Mapping[str, FloatArray]
    traps: Traps
    folder: Path

    @classmethod
    def load(cls, folder: Path, name: str, rows: Mapping[str, Any]) -> "CornerField":
        """Reads the field of one network from the folder of a trial and its row."""
        with np.load(folder / f"{name}.npz") as stored:
            along = {part: stored[part] for part in ("speed", "progress")}
        return cls(rows[name], along, Traps.of(rows[name], along["progress"]), folder)


CornerFields = Mapping[tuple[int, int, str], CornerField]
"""Fields by the number of corners, the seed and the network."""


def fields_table(found: CornerFields) -> pd.DataFrame:
    """Returns one row a field: what it is, and the figures of `examine`."""
    return pd.DataFrame(
        {
            "corners": corners,
            "angle": 180 - 360 / corners,
            "network": name,
            "seed": seed,
            "even": even_share(corners, item.row["unit"]),
            **examine(item.row, item.along, corners),
            "restarts": item.row["restarts"],
        }
        for (corners, seed, name), item in found.items()
    )


def stalls_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns one row a polygon and network: who stalls, and where."""
    return pd.DataFrame(
        {
            **_labels(rows),
            **interval_columns("stalled, %", 100 * rows["stalled"], PERCENT),
            **interval_columns("stalled near a corner, %", 100 * rows["stalled_near"], PERCENT),
            **interval_columns("near, of the stalled, %", 100 * rows["near"], PERCENT),
            "near, of the path, %": 100 * rows["even"].iloc[0],
            **interval_columns("laps, %", 100 * rows["lapped"], PERCENT),
            "paused, %": 100 * rows["paused"].mean(),
            "RMS, U": rows["rms"].mean(),
        }
        for rows in _groups(table)
    )


def traps_table(table: pd.DataFrame, found: CornerFields) -> pd.DataFrame:
    """Returns one row a polygon and network: the traps, and the speed."""
    rows = []
    for group in _groups(table):
        corners, network = int(group["corners"].iloc[0]), str(group["network"].iloc[0])
        places = [found[corners, seed, network].traps.at_corners for seed in group["seed"]]
        along, outside, distance = np.concatenate(places).T
        rows.append(
            {
                **_labels(group),
                **interval_columns("corners with a trap, %", 100 * group["trapped"], PERCENT),
                "traps": len(along),
                "before / after / clash": f"{(along < 0).sum()} / {(along >= 0).sum()} / "
                f"{np.isnan(along).sum()}",
                "outside": int((outside > 0).sum()),
                "distance, U": distance.mean() if len(distance) else None,
                **interval_columns("|m| at corners", group["speed_corner"]),
                **interval_columns("|m| on sides", group["speed_side"]),
            }
        )
    return pd.DataFrame(rows)


def _groups(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Returns the rows of each polygon and network, sharp corners and shallow first."""
    return [
        rows
        for _, polygon in table.groupby("corners")
        for network in NETWORKS
        if len(rows := polygon[polygon["network"] == network])
    ]


def _labels(rows: pd.DataFrame) -> dict[str, Any]:
    return {
        "angle, degrees": rows["angle"].iloc[0],
        "network": rows["network"].iloc[0],
        "fields": len(rows),
    }
