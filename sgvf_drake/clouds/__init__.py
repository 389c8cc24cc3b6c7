"""What is followed: point clouds, from arrays and from the files that people have."""

from sgvf_drake.clouds.geodesy import Origin
from sgvf_drake.clouds.point_cloud import PointCloud

__all__ = ["Origin", "PointCloud"]
