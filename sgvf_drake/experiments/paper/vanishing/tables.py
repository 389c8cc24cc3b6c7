"""The tables of score vanishing."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.paper.intervals import interval_columns

Row = Mapping[str, Any]
Cases = Mapping[tuple[str, str], Sequence[Row]]


def score_zeros(row: Row) -> list[dict[str, Any]]:
    """Returns the zeros of the score of a field, with distances in U."""
    return [
        {**zero, "path_distance": zero["path_distance"] / row["unit"]}
        for zero in row["zeros"]
        if zero["field"] == "score"
    ]


def counts_table(rows: Cases) -> pd.DataFrame:
    """Returns one row a shape and recipe: the zeros of the score, and their indices."""
    return pd.DataFrame(
        {
            "shape": shape,
            "score": recipe,
            **interval_columns(
                "zeros on the path", [r["vanishing"]["zeros_on_path"] for r in own]
            ),
            **interval_columns("zeros off it", [r["vanishing"]["zeros_off_path"] for r in own]),
            "forced": forced(own[0]),
            "indices on the path": _one(r["vanishing"]["index_sum_on_path"] for r in own),
            "indices off it": _one(r["vanishing"]["index_sum_off_path"] for r in own),
            "on the border": _one(r["score_winding_number"] for r in own),
            "regions as topology has them": _count(
                region["index_sum"] == region["euler"] for r in own for region in r["regions"]
            ),
        }
        for (shape, recipe), own in rows.items()
    )


def forced(row: Row) -> int:
    """Returns the least number of zeros of index one or minus one in the regions."""
    return sum(abs(region["euler"]) for region in row["regions"])


def places_table(rows: Cases) -> pd.DataFrame:
    """Returns one row a shape and recipe: whether zeros keep to low density or to bends."""
    columns = {
        "low_density": "lower density than in the box",
        "low_density_off_path": "the same off the path",
        "high_curvature": "higher curvature than along the path",
    }
    return pd.DataFrame(
        {
            "shape": shape,
            "score": recipe,
            **{
                label: _chance([r["vanishing"][name] for r in own])
                for name, label in columns.items()
            },
            "least |m| on the path": min(
                r["vanishing"]["guiding_min_at_score_zeros_on_path"] for r in own
            )
            if recipe == "robust"
            else None,
            "correlation of |S| and log p": np.mean(
                [r["vanishing"]["density_correlation"] for r in own]
            ),
        }
        for (shape, recipe), own in rows.items()
    )


def parametric_table(pieces: Mapping[str, Sequence[Row]], rows: Cases) -> pd.DataFrame:
    """Returns one row a piece: the least |chi|."""
    return pd.DataFrame(
        {
            "shape": shape,
            "piece": number + 1,
            "least |chi| on the grid": piece["grid"],
            "after descents": piece["least"],
            "by the formula": piece["formula"],
            "least speed in the plane": piece["plane"],
            "zeros of m (SGVF)": np.mean(
                [
                    sum(zero["field"] == "guiding" for zero in row["zeros"])
                    for row in rows[shape, "robust"]
                ]
            ),
        }
        for shape, own in pieces.items()
        for number, piece in enumerate(own)
    )


def zeros_log(rows: Cases, seeds: Sequence[int]) -> pd.DataFrame:
    """Returns one row a zero of the score: where it is, its index, and what is around it."""
    names = ("index", "kind", "path_distance", "density_percentile", "guiding_norm")
    return pd.DataFrame(
        {
            "shape": shape,
            "score": recipe,
            "seed": seed,
            "x": zero["point"][0],
            "y": zero["point"][1],
            **{name: zero[name] for name in names},
        }
        for (shape, recipe), own in rows.items()
        for seed, row in zip(seeds, own, strict=True)
        for zero in score_zeros(row)
    )


def _one(values: Iterable[int]) -> str:
    """Returns whole numbers as they are, once where all are the same."""
    return ", ".join(str(value) for value in sorted(set(values)))


def _count(conditions: Iterable[bool]) -> str:
    found = list(conditions)
    return f"{sum(found)} of {len(found)}"


def _chance(verdicts: Sequence[Mapping[str, Any] | None]) -> str | None:
    known = [verdict for verdict in verdicts if verdict is not None]
    if not known:
        return None
    mean = np.mean([verdict["probability"] for verdict in known])
    return f"{mean:.2f} ({_count(verdict['holds'] for verdict in known)})"
