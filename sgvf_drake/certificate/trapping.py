"""m points into a ring everywhere on its border: what is in it stays, and so a closed orbit is.

The border is a pair of polygons, and m is bounded on their sides alone, along the line; that
takes squares in proportion to the length of a piece where its tube takes them to its area.
"""

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.annulus import ROUNDING, Annulus
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.fields import GuidingField

# Times that a side is halved where its bound does not tell.
HALVINGS = 5


def is_trapping(field: GuidingField, annulus: Annulus) -> tuple[bool, int]:
    """Whether m points into a ring all along its border, and how many squares that took.

    At a corner m points into the half-planes of both sides, and so into the ring.

    Args:
        field: m.
        annulus: The ring, which has to be one (`Annulus.is_ring`).
    """
    inner, outer = annulus.borders
    # Out of the ring is to the right of the outer polygon and to the left of the inner one,
    # which is to the right when that is walked backwards.
    start = np.concatenate([outer, np.roll(inner, -1, axis=0)])
    end = np.concatenate([np.roll(outer, -1, axis=0), inner])
    squares = 0
    for _ in range(HALVINGS + 1):
        outward, at_middle = _outward(field, start, end)
        squares += len(start)
        still = ~(outward < 0)
        if not still.any():
            return True, squares
        if (at_middle > 0).any():
            break
        start, end = start[still], end[still]
        middle = (start + end) / 2
        start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
    return False, squares


def _outward(
    field: GuidingField, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns bounds of m to the right of segments (n, 2).

    From above on all of them, and from below at their middles.
    """
    step = (end - start) / 2
    half = np.abs(step).max(axis=1)
    centers = (start + end) / 2
    off = ROUNDING * (1 + np.abs(centers).max())
    normal = np.column_stack([step[:, 1], -step[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore"):
        m = model_field(field, Boxes(centers, half + off))
        across = m.weighted(normal)
        slope = (across.jacobian[..., 0] * step).sum(axis=1)
        squares = np.column_stack([step[:, 0] ** 2, step[:, 0] * step[:, 1], step[:, 1] ** 2])
        bend = (across.quadratic[..., 0] * squares).sum(axis=1)
        # The middle and the line are off by rounding.
        rounding = SLACK * across.magnitude[:, 0]
        rounding += off * np.abs(across.jacobian).sum(axis=(1, 2))
        at_middle = across.value[:, 0]
        rest = across.remainder[:, 0] + rounding
        on_segment = at_middle + np.abs(slope) + np.maximum(bend, 0) + rest
    return on_segment, at_middle - rest
