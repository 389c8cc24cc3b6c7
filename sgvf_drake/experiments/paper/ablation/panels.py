"""The fields of both ablations as they are drawn, from the files of a trial."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from sgvf_drake.experiments.figures.ablation import FieldPanel, arrow_grid
from sgvf_drake.experiments.paper.ablation.along_path import directions, sample_path
from sgvf_drake.experiments.paper.ablation.measures import ENDS, FOLLOWED
from sgvf_drake.fields import Field, GuidingField, load_field
from sgvf_drake.paths import shape_path


def panels_of(
    folder: Path, shape: str, names: Mapping[str, str], drawn: Callable[[GuidingField], Field]
) -> list[FieldPanel]:
    """Returns the panels of the variants of a trial, in the order of their names.

    Args:
        folder: Of the trial, with `VARIANT.safetensors` and `VARIANT.npz` of each.
        shape: The named shape.
        names: What each variant is called.
        drawn: What is drawn of a field.
    """
    reference = shape_path(shape)
    panels = []
    for variant, title in names.items():
        field = load_field(folder / f"{variant}.safetensors")
        run = np.load(folder / f"{variant}.npz")
        unit = field.cloud.unit_length
        part = drawn(field)
        samples = sample_path(reference, unit)
        pieces = directions(samples, part(samples.points), unit)
        x = arrow_grid(field.cloud.box)
        panels.append(
            FieldPanel(
                title=title,
                points=field.cloud.points,
                lengths=np.linalg.norm(part(field.cloud.points), axis=1),
                x=x,
                vectors=part(x),
                sources=np.concatenate([piece.sources for piece in pieces]),
                sinks=np.concatenate([piece.sinks for piece in pieces]),
                stopped=run[ENDS][~run[FOLLOWED]],
            )
        )
    return panels
