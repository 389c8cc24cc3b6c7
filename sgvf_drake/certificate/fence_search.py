"""Proposes fences: around zeros of m from which robots leave, and the lines that lead to them.

Robots come to a saddle along its stable manifold alone: a line that comes from outside of the
box, or from a source.  m points away from it on both sides.  So the fence runs on both sides of
the line, as near as the squares can tell, and widens where m would not cross it otherwise.
What it holds is narrow, however the line lies to the squares.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov, sqrtm
from scipy.optimize import root

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.cells import HALF
from sgvf_drake.certificate.fences import Fence
from sgvf_drake.certificate.field_model import ExactField
from sgvf_drake.certificate.trajectories import Rate, rate_of
from sgvf_drake.fields import GuidingField

# The half-width of a fence at a saddle, normalised, and squares that are small beside it.
NEAR = 0.06
FINE = NEAR / 3
# m crosses a fence at this angle at least, rad; the spacing of its vertices.
ANGLE, STEP = 0.1, 0.02
# A fence ends where it is as wide, or so far from the saddle.
WIDEST, LONGEST = 1.0, 15.0
# How precisely the line is traced: a fence beside it is what counts.
PRECISION: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-8}
# Sides of an ellipse.
SIDES = 64
# m vanishes where it is as small; zeros that are as near to each other are one.
STILL, SAME = 1e-9, 1e-3


def find_fences(field: GuidingField, near: FloatArray) -> list[Fence]:
    """Returns fences around saddles, and around zeros from which robots spiral away.

    Args:
        field: The field, in the plane.
        near: (n, 2) places near zeros of m, normalised.
    """
    found = []
    for zero, jacobian in _zeros(field, near):
        rates, directions = np.linalg.eig(jacobian)
        if np.iscomplexobj(rates) and rates.real.min() > 0:
            found.append(_around_focus(zero, jacobian))
        elif np.isrealobj(rates) and rates.min() < 0 < rates.max():
            found.append(_around_saddle(field, zero, directions[:, np.argmin(rates)]))
    return found


def _zeros(field: GuidingField, near: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Returns zeros near some places, each once, and the Jacobian (2, 2) at each."""
    center, unit = field.cloud.center, field.cloud.unit_length
    found: list[FloatArray] = []

    def value_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        m, jacobian = field.value_and_jacobian(center + unit * z)
        return m, unit * jacobian

    for start in near:
        zero = root(value_and_slope, start, jac=True, method="lm")
        known = any(np.abs(zero.x - other).max() < SAME for other in found)
        vanishes = np.abs(zero.fun).max() < STILL and np.abs(zero.x).max() < HALF
        if vanishes and not known:
            found.append(zero.x)
            yield zero.x, value_and_slope(zero.x)[1]


def _around_focus(focus: FloatArray, jacobian: FloatArray) -> Fence:
    """Returns an ellipse that robots cross outward near a focus, where that is unstable."""
    # The one with Q J + J' Q = 2 I.
    Q = solve_continuous_lyapunov(jacobian.T, 2 * np.eye(2))
    root_of_Q = sqrtm(Q / np.sqrt(np.linalg.det(Q))).real
    angles = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    circle = NEAR * np.column_stack([np.cos(angles), np.sin(angles)])
    return Fence.through(focus + np.linalg.solve(root_of_Q, circle.T).T)


def _around_saddle(field: ExactField, saddle: FloatArray, come: FloatArray) -> Fence:
    """Returns the fence around a saddle, to which robots come in this direction."""
    rate, sides = rate_of(field), []
    for way in (come, -come):
        line = _backwards(rate, saddle, way)
        onward = np.gradient(line, axis=0)
        onward /= np.linalg.norm(onward, axis=1, keepdims=True)
        left, right = (_beside(rate, line, onward, side) for side in (1.0, -1.0))
        # The left of the one way begins where the right of the other does.
        sides += [right, left[:0:-1]]
    return Fence.through(np.concatenate(sides))


def _backwards(rate: Rate, saddle: FloatArray, way: FloatArray) -> FloatArray:
    """Returns points (n, 2) from a saddle back along its stable manifold, on one way."""
    start = saddle + STEP * way
    slow = np.linalg.norm(rate(0.0, start)) / 2

    def back(t: float, z: FloatArray) -> FloatArray:
        m = rate(t, z)
        return -m / np.linalg.norm(m)

    def ends(t: float, z: FloatArray) -> float:
        """Falls below zero out of the box, and at a source, from which robots come."""
        return float(min(HALF + 2 * STEP - np.abs(z).max(), np.linalg.norm(rate(t, z)) - slow))

    ends.terminal = True  # type: ignore[attr-defined]
    run = solve_ivp(back, (0, LONGEST), start, events=ends, dense_output=True, **PRECISION)
    line = run.sol(np.linspace(0, run.t[-1], int(run.t[-1] / STEP) + 2)).T
    return np.concatenate([saddle[None], line])


def _beside(rate: Rate, line: FloatArray, onward: FloatArray, side: float) -> FloatArray:
    """Returns points (n, 2) beside a line, on its left (1) or right (-1).

    m crosses the polygon away from the line.

    Args:
        rate: m, which comes back along the line.
        line: (n, 2) its points.
        onward: (n, 2) its unit tangents.
        side: Which side.
    """
    aside = side * np.column_stack([-onward[:, 1], onward[:, 0]])
    width, points = NEAR, []
    for point, forth, off in zip(line, onward, aside, strict=True):
        if width > WIDEST:
            break
        points.append(point + width * off)
        m = rate(0.0, points[-1])
        # It widens as fast as m would have to turn.
        width += STEP * max(0.0, ANGLE - np.arctan2(m @ off, -m @ forth))
    return np.array(points)
