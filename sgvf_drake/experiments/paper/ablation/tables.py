"""The tables of both ablations: one row a field, and one row a variant over the seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.paper.intervals import POSITIVE, SHARE, interval_columns
from sgvf_drake.experiments.workbench import Record

Range = tuple[float, float]
ANY: Range = (-np.inf, np.inf)

FOLLOWED = {
    "reach": ("following.reach", SHARE),
    "lap": ("following.lap", SHARE),
    "stall": ("following.stall", SHARE),
    "leave": ("following.leave", SHARE),
    "RMS, U": ("following.rms_u", POSITIVE),
}
"""Columns that say how well a field is followed; see `seeds_table`."""


def field_table(labels: Sequence[Mapping[str, Any]], records: Sequence[Record]) -> pd.DataFrame:
    """Returns one row a field, a measure "part.name" a column.

    Args:
        labels: The first columns of each trial.
        records: Of the trials, each with a row of measures for each variant.
    """
    rows = [
        {**label, "variant": variant, **measures}
        for label, record in zip(labels, records, strict=True)
        for variant, measures in record.row.items()
    ]
    return pd.json_normalize(rows)


def seeds_table(
    table: pd.DataFrame,
    groups: Sequence[str],
    names: Mapping[str, str],
    counts: Mapping[str, str],
    means: Mapping[str, tuple[str, Range]],
) -> pd.DataFrame:
    """Returns one row a group, with what its seeds say.

    Args:
        table: From `field_table`.
        groups: The columns that make a group, the last the variant.
        names: What each variant is called.
        counts: Columns "k of n" by their header, of a yes-or-no measure.
        means: Columns of means with their interval by their header, each of a measure and
            the range of its mean.
    """
    rows = []
    for key, fields in table.groupby(list(groups), sort=False):
        assert isinstance(key, tuple)
        row: dict[str, Any] = dict(zip(groups, key, strict=True))
        row["variant"] = names[row["variant"]]
        for header, measure in counts.items():
            row[header] = f"{int(fields[measure].sum())} of {len(fields)}"
        for header, (measure, within) in means.items():
            row.update(interval_columns(header, fields[measure].astype(float), within))
        rows.append(row)
    return pd.DataFrame(rows)
