"""The path that a field was made for, where nothing else is known of it."""

from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import Reference, TreeReference, shape_path, trace_pieces


def learned_path(field: GuidingField) -> Reference:
    """Returns the path that a field was made for: its named shape, or else a spanning tree.

    The tree is that of the points whose score was learned, which are cleaned of noise and
    strays, and is open where the field has an end.
    """
    if field.cloud.shape is not None:
        return shape_path(field.cloud.shape)
    points = field.mixture.points
    tree = TreeReference(points, trace_pieces(points))
    return tree.opened_at(field.ends, field.cloud.unit_length)
