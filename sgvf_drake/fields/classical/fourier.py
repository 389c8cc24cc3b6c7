"""Trigonometric interpolation of ordered waypoints."""

import numpy as np

from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.base import check_positive
from sgvf_drake.fields.classical.curve import HIGHEST_ORDER, Curve

# A wave of exactly the shortest length is kept.
_ROUNDING = 1e-9


class FourierCurve(Curve):
    """The trigonometric interpolant of waypoints at equal steps of the parameter.

    A closed curve is the discrete Fourier series of its waypoints.  An open one is a
    straight line plus a sine series: what is left of the waypoints without the line from
    the first to the last one is zero at both ends, and its odd continuation is periodic.
    """

    def __init__(self, points: FloatArray, closed: bool = True) -> None:
        super().__init__(points, closed)
        self._offset, self._slope = np.zeros((2, self.points.shape[1]))
        values, period = self.points, self.length
        if not closed:
            self._offset = self.points[0]
            self._slope = (self.points[-1] - self.points[0]) / self.length
            w = np.linspace(0, self.length, len(self.points))[:, None]
            rest = self.points - self._offset - w * self._slope
            values, period = np.concatenate([rest, -rest[-2:0:-1]]), 2 * self.length
        series = 2 * np.fft.rfft(values, axis=0) / len(values)
        # The constant, and the highest frequency of an even number, stand there once.
        series[0] /= 2
        if len(values) % 2 == 0:
            series[-1] /= 2
        self._fundamental = 2 * np.pi / period
        self._set_series(series.real, -series.imag)

    def smoothed(self, wavelength: float) -> "FourierCurve":
        """Returns the curve without its waves that are shorter than a length.

        It no longer passes the waypoints: of all series of the longer waves it is the one
        with the least squares of the distances to them.

        Args:
            wavelength: In the unit of w.

        Raises:
            ConfigurationError: The length is not a positive number.
        """
        check_positive("wavelength", wavelength)
        curve = FourierCurve(self.points, self.closed)
        shortest = 2 * np.pi / (wavelength * self._fundamental)
        kept = int(shortest * (1 + _ROUNDING)) + 1
        curve._set_series(self._cosines[:kept], self._sines[:kept])
        return curve

    def derivatives(self, w: FloatArray, order: int) -> FloatArray:
        dim = self.points.shape[1]
        values = self._waves(w) @ self._amplitudes[:, : (order + 1) * dim]
        values[:, :dim] += self._offset + w[:, None] * self._slope
        if order > 0:
            values[:, dim : 2 * dim] += self._slope
        return values.reshape(len(w), order + 1, dim).transpose(1, 0, 2)

    def _waves(self, w: FloatArray) -> FloatArray:
        """Returns the cosines and then the sines of all frequencies, (n,) -> (n, 2 K)."""
        if np.iscomplexobj(w):
            phases = np.multiply.outer(w, self._frequencies)
            return np.concatenate([np.cos(phases), np.sin(phases)], axis=1)
        # By the powers of the first wave: many times faster, and as exact to 14 digits.
        first = np.exp(1j * self._fundamental * w)
        powers = np.vander(first, len(self._frequencies), increasing=True)
        return np.concatenate([powers.real, powers.imag], axis=1)

    def _set_series(self, cosines: FloatArray, sines: FloatArray) -> None:
        """Keeps amplitudes (K, d), and beside them those of the derivatives."""
        self._cosines, self._sines = cosines, sines
        self._frequencies = self._fundamental * np.arange(len(cosines))
        blocks = []
        for _ in range(HIGHEST_ORDER + 1):
            blocks.append(np.concatenate([cosines, sines]))
            cosines, sines = (
                self._frequencies[:, None] * sines,
                -self._frequencies[:, None] * cosines,
            )
        self._amplitudes = np.concatenate(blocks, axis=1)
