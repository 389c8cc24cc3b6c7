"""Find the singularities of a field and measure the paper's claim about them."""

from os import PathLike
import time
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.certificate import ZeroList, enclose_zeros
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.singularities import (
    log_density_figure,
    singularity_figure,
    spatial_figure,
)
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov import (
    PARTS,
    Singularities,
    Vanishing,
    find_singularities,
    measure_vanishing,
)
from sgvf_drake.paths import ReferencePath

SINGULARITIES_FILES = (SUMMARY, "zeros.csv", "singularities.png", "log_density.png")

AXES = "xyz"
"""The names of the coordinates."""

Row = dict[str, Any]


def run_singularities(
    field: GuidingField,
    reference: tuple[ReferencePath, str] | None,
    out: str | PathLike[str],
    *,
    prove: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Finds the zeros of a field; leaves a table, two figures (in space one) and the summary.

    To `prove` is to enclose the zeros too, with a proof that there are no others.

    Raises:
        ConfigurationError: The field has more than three dimensions, its zeros have no index,
            or nothing bounds the derivatives that a proof needs.
    """
    if field.dim > 3:
        raise ConfigurationError(f"singularities are found up to 3-D, not in {field.dim}-D")
    path, kind = reference or choose_reference(field)
    with result_folder(out, SINGULARITIES_FILES, overwrite=overwrite) as folder:
        # First, since it refuses some fields.
        proved = {}
        if prove:
            proved["proved"] = {part: _proved(enclose_zeros(field, part)) for part in PARTS}
        begin = time.perf_counter()
        found = find_singularities(field)
        vanishing = measure_vanishing(field, found, path)
        elapsed = time.perf_counter() - begin
        zeros = zero_rows(found, vanishing)
        zero_table(zeros, field.dim).to_csv(folder / "zeros.csv", index=False)
        draw = singularity_figure if field.dim == 2 else spatial_figure
        save_figure(draw(field, found), folder / "singularities.png")
        if field.dim == 2:
            save_figure(log_density_figure(field, found), folder / "log_density.png")
        summary = {
            **singularity_summary(found),
            "vanishing": vanishing.summary,
            "zeros": zeros,
            **proved,
            "time_s": elapsed,
            "unit_length": field.cloud.unit_length,
            "reference": kind,
            **origin(field),
        }
        write_summary(folder, summary)
    return summary


def singularity_summary(found: Singularities) -> dict[str, Any]:
    """Returns winding numbers and sums of indices, by the names of `summary.json`."""
    parts = {"": found.guiding, "score_": found.score, "tangent_": found.tangent}
    summary: dict[str, Any] = {}
    for prefix, zeros in parts.items():
        summary[f"{prefix}winding_number"] = zeros.winding_number
        summary[f"{prefix}index_sum"] = zeros.index_sum
    undecided = {name: zeros.undecided for name, zeros in found.by_field.items()}
    return {
        **summary,
        "undecided": sum(undecided.values()),
        "undecided_by_field": undecided,
        "cells": sum(zeros.cells for zeros in found.by_field.values()),
        "box": found.box,
    }


def _proved(found: ZeroList) -> dict[str, Any]:
    """Returns what is proved of the zeros of a part of a field."""
    return {
        "complete": found.complete,
        "zeros": [
            {
                **dict(zip(AXES, zero.point, strict=False)),
                "radius": zero.radius,
                "index": zero.index,
                "kind": zero.kind,
                "stable": zero.stable,
            }
            for zero in found.zeros
        ],
        "undecided": found.undecided,
        "winding_number": found.winding_number,
        "index_sum": found.index_sum,
        "boxes": found.boxes,
        "box": found.box,
    }


def zero_rows(found: Singularities, vanishing: Vanishing) -> list[Row]:
    """Returns one row a zero: what it is, and for m and the score what is around it."""
    around = {"guiding": vanishing.guiding, "score": vanishing.score}
    rows = []
    for name, zeros in found.by_field.items():
        own: list[Row] = [
            {
                "field": zero.field,
                "point": zero.point,
                "index": zero.index,
                "kind": zero.kind,
                "stable": zero.stable,
                "unstable_directions": int((zero.eigenvalues.real > 0).sum()),
                "eigenvalues": [[value.real, value.imag] for value in zero.eigenvalues],
                "residual": zero.residual,
            }
            for zero in zeros.zeros
        ]
        if name in around:
            columns: Any = around[name].drop(columns=["indices", "isolated"]).to_dict("records")
            own = [{**row, **here} for row, here in zip(own, columns, strict=True)]
        rows += own
    return rows


def zero_table(rows: list[Row], dim: int = 2) -> pd.DataFrame:
    """Returns the rows as a table, with a column for each number."""
    table = pd.DataFrame(rows)
    points = np.array([row["point"] for row in rows]).reshape(-1, dim)
    eigenvalues = np.array([row["eigenvalues"] for row in rows]).reshape(-1, 2 * dim)
    numbers = range(1, dim + 1)
    names = [f"eigenvalue_{number}_{part}" for number in numbers for part in ("real", "imag")]
    return pd.concat(
        [
            pd.DataFrame(points, columns=list(AXES[:dim])),
            table.drop(columns=["point", "eigenvalues"], errors="ignore"),
            pd.DataFrame(eigenvalues, columns=names),
        ],
        axis=1,
    )
