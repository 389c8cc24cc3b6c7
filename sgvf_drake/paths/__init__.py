"""The paths of point clouds: their pieces, and the true ones for the metrics.

`find_paths` is in `sgvf_drake.paths.finding`, since it takes a while to import.
"""

from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.reference import Piece, Projection, ReferencePath
from sgvf_drake.paths.shapes import SHAPES, make_shape, shape_path

__all__ = [
    "SHAPES",
    "PathNetwork",
    "Piece",
    "Projection",
    "ReferencePath",
    "make_shape",
    "shape_path",
]
