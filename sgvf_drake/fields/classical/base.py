"""What the classical fields share: an approach length, ends, and unit vectors."""

import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.analytic import AnalyticField
from sgvf_drake.fields.base import FloatArray

# 1/U.  The fields turn to the path over a tenth of a unit, the default noise level of a
# learned score, so that all of them see the path at the same scale.
DEFAULT_GAIN = 10.0


class ClassicalField(AnalyticField):
    """A field that is computed from waypoints by a formula; nothing is learned.

    What it is made of is in the normalised units of its cloud; calls are in the user's.
    """

    gain: float
    """1/U: at a small distance r from the path, the part of m that points to it is gain r."""

    @property
    def approach_length(self) -> float:
        """The distance over which m turns to the path, 1 / gain, in the user's unit."""
        return self.cloud.unit_length / self.gain

    @property
    def sigma(self) -> float:
        """The scale of the field across its path, U: the approach length."""
        return 1 / self.gain

    @property
    def ends(self) -> FloatArray:
        """Where robots come to rest, (E, d) in the user's unit; none unless a kind has them."""
        return np.empty((0, self.cloud.dim))


def check_positive(name: str, value: float) -> None:
    """Raises ConfigurationError unless a value is a positive number."""
    if not (np.isfinite(value) and value > 0):
        raise ConfigurationError(f"{name} must be a positive number, not {value}")


def direction(n: FloatArray, softening: float) -> FloatArray:
    """Returns n / sqrt(|n|^2 + softening^2): (k, d) -> (k, d), real or complex."""
    return n / np.sqrt((n * n).sum(axis=1) + softening**2)[:, None]


def direction_and_jacobian(
    n: FloatArray, dn: FloatArray, softening: float
) -> tuple[FloatArray, FloatArray]:
    """Returns `direction` and its derivative (k, d, d), where n has the derivative dn."""
    norm = np.sqrt((n * n).sum(axis=1) + softening**2)
    m = n / norm[:, None]
    along = (m[:, None, :] @ dn)[:, 0]
    return m, (dn - m[:, :, None] * along[:, None, :]) / norm[:, None, None]
