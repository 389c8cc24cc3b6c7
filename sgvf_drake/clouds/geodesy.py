"""Degrees to local metres: east, north and up about an origin on the WGS84 ellipsoid.

Both steps are exact and in closed form: geodetic coordinates to Earth-centred Cartesian ones,
and a rotation of these into the axes of the origin.  So neither the poles nor the meridian of
180 degrees are special.
"""

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray

SEMI_MAJOR_AXIS = 6_378_137.0
"""Equatorial radius of the WGS84 ellipsoid in metres."""

FLATTENING = 1 / 298.257223563
"""Flattening of the WGS84 ellipsoid."""

ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)

ORIGIN_DECIMALS = 5
"""Decimals of an origin in degrees, about a metre: five tell it without rounding."""

Origin = tuple[float, float, float]
"""Latitude and longitude in degrees, and the height above the ellipsoid in metres."""


def earth_centred(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
    """Returns Earth-centred Cartesian coordinates (..., 3) in metres.

    Args:
        latitude: Geodetic, in degrees.
        longitude: In degrees; any multiple of 360 may be added.
        height: Above the ellipsoid, in metres.
    """
    normal = _normal(latitude, longitude)
    height = np.asarray(height, dtype=np.float64)[..., None]
    # The radius of curvature in the prime vertical.
    radius = SEMI_MAJOR_AXIS / np.sqrt(1 - ECCENTRICITY_SQUARED * normal[..., 2:] ** 2)
    shrunk = np.array([1, 1, 1 - ECCENTRICITY_SQUARED])
    position: FloatArray = (radius * shrunk + height) * normal
    return position


def east_north_up(
    latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, origin: Origin
) -> FloatArray:
    """Returns coordinates (..., 3) in metres along east, north and up of an origin.

    Args:
        latitude: Geodetic, in degrees.
        longitude: In degrees.
        height: Above the ellipsoid, in metres.
        origin: Where they are zero.
    """
    offset = earth_centred(latitude, longitude, height) - earth_centred(*origin)
    phi, lam = np.radians(origin[:2])
    east = [-np.sin(lam), np.cos(lam), 0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    local: FloatArray = offset @ np.array([east, north, _normal(*origin[:2])]).T
    return local


def middle(latitude: FloatArray, longitude: FloatArray) -> Origin:
    """Returns an origin amid places, at height zero: the mean of their normals, rounded."""
    x, y, z = _normal(latitude, longitude).mean(axis=0)
    degrees = np.degrees([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)])
    phi, lam = (float(value) for value in np.round(degrees, ORIGIN_DECIMALS))
    return phi, lam, 0.0


def origin_text(origin: Origin) -> str:
    """Returns an origin as people write it: "12.50000 N, 38.25000 W"."""
    halves = (("N", "S"), ("E", "W"))
    return ", ".join(
        f"{abs(value):.{ORIGIN_DECIMALS}f} {half[value < 0]}"
        for value, half in zip(origin[:2], halves, strict=True)
    )


def _normal(latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
    """The outward normals (..., 3) of the ellipsoid."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    return np.stack(
        [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], axis=-1
    )
