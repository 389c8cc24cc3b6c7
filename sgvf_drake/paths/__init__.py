"""What is followed: point clouds, their pieces, and the true paths for the metrics."""

from sgvf_drake.paths.ends import reverse, signed_area, with_ends
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.point_cloud import PointCloud
from sgvf_drake.paths.reading import read_points
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
    "PointCloud",
    "Projection",
    "Reference",
    "ReferencePath",
    "TracedPiece",
    "TreeReference",
    "find_paths",
    "make_shape",
    "read_points",
    "reverse",
    "shape_path",
    "signed_area",
    "trace_pieces",
    "tree_reference",
    "with_ends",
]
