"""How fast neighbouring orbits come together: bounds from models of the derivatives of m."""

from collections.abc import Sequence

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel

# Beyond the rounding of eigenvalues and frames, relative to the norm of a matrix, by far.
ROUNDING = 1e-9


def rate_of_distances(dual: DualModel) -> FloatArray:
    """Returns bounds of (v . J v) / |v|^2 from above, for every v, (n,).

    Distances between orbits change at this rate at most, relative to themselves.
    """
    S, off = _symmetric_part(dual)
    return np.asarray(_largest(S) + off)


def rate_across(dual: DualModel) -> FloatArray:
    """Returns bounds from above of the rate at which lengths across m change, (n,).

    In the plane it is that of |m| |v|, which is div m.  In other spaces it is that of |v|:
    (v . J v) / |v|^2 with any v normal to m.
    """
    if len(dual.slopes) == 2:
        return np.asarray(dual.divergence.upper[:, 0])
    S, off = _symmetric_part(dual)
    m, m_off = (parts[..., 0] for parts in _middles((dual.value,)))
    length, m_off = np.linalg.norm(m, axis=1), np.linalg.norm(m_off, axis=1)
    # A v normal to m is E y + z t with |z| <= tilt |y|, where t is along the middle of m and E
    # normal to that.
    frame = np.linalg.qr(np.nan_to_num(m)[:, :, None], mode="complete")[0]
    t, E = frame[:, :, :1], frame[:, :, 1:]
    known = m_off < length / 2
    tilt = np.where(known, (1 + ROUNDING) * m_off / np.where(known, length - m_off, 1.0), 1.0)
    mixed = np.linalg.norm(S @ t, axis=(1, 2))
    rate = _largest(E.swapaxes(1, 2) @ S @ E) + (2 * tilt + tilt**2) * mixed
    # That times |y|^2 is the form, and |v|^2 is up to 1 + tilt^2 times as much.
    rate = np.where(rate < 0, rate / (1 + tilt**2), rate)
    return np.where(known, rate + off, np.inf)


def _symmetric_part(dual: DualModel) -> tuple[FloatArray, FloatArray]:
    """Returns symmetric matrices (n, d, d), and how far that of J is off at most, (n,).

    The second holds the rounding of eigenvalues and of orthogonal frames, too.
    """
    J, J_off = _middles(dual.slopes)
    off = np.linalg.norm(J_off, axis=(1, 2)) + ROUNDING * np.linalg.norm(J, axis=(1, 2))
    return (J + J.swapaxes(1, 2)) / 2, (1 + ROUNDING) * off


def _largest(S: FloatArray) -> FloatArray:
    """Returns the largest eigenvalues of symmetric matrices; NaN where one is not finite."""
    finite = np.asarray(np.isfinite(S).all(axis=(1, 2)))
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], S, 0.0))[:, -1]
    return np.where(finite, values, np.nan)


def _middles(models: Sequence[TaylorModel]) -> tuple[FloatArray, FloatArray]:
    """Returns numbers (n, f, len(models)), and how far the functions go from them at most."""
    low, high = (
        np.stack([getattr(model, side) for model in models], axis=2)
        for side in ("lower", "upper")
    )
    middle = (low + high) / 2
    return middle, (1 + SLACK) * np.maximum(high - middle, middle - low)
