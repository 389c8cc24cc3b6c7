"""The paths of point clouds: their pieces, and the true ones for the metrics.

`find_paths` is in `sgvf_drake.paths.finding`, since it takes a while to import.
"""

from sgvf_drake.paths.ends import reverse, with_ends
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.reference import (
    Piece,
    Projection,
    Reference,
    ReferencePath,
    TreeReference,
    tree_reference,
)
from sgvf_drake.paths.shapes import SHAPES, make_shape, shape_path
from sgvf_drake.paths.spanning_tree import TracedPiece, trace_pieces

__all__ = [
    "SHAPES",
    "PathNetwork",
    "Piece",
    "Projection",
    "Reference",
    "ReferencePath",
    "TracedPiece",
    "TreeReference",
    "make_shape",
    "reverse",
    "shape_path",
    "trace_pieces",
    "tree_reference",
    "with_ends",
]
