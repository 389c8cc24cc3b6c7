"""Proposes fences: beside the lines along which robots come to where they stay, or part.

Robots come to a saddle along its stable manifold alone: a line that comes from outside of the
box, or from a source.  m points away from it on both sides.  There are such lines without a
saddle too: between two strands that m leads to, it runs along the line for a while.  So a fence
runs on both sides of the line, as near as the squares can tell, and widens where m would not
cross it otherwise.  What it holds is narrow, however the line lies to the squares.
"""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov, sqrtm

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.cells import HALF
from sgvf_drake.certificate.fences import Fence
from sgvf_drake.certificate.trajectories import Rate, rate_of
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov import find_guiding_zeros

# The half-width of a fence at a line, normalised, and squares that are small beside it.
NEAR = 0.06
FINE = NEAR / 3
# m crosses a fence at this angle at least, rad; the spacing of its vertices.
ANGLE, STEP = 0.1, 0.02
# A fence ends where it is as wide, or so far from where it begins.
WIDEST, LONGEST = 1.0, 15.0
# How precisely the line is traced: a fence beside it is what counts.
PRECISION: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-8}
# A line without a saddle ends where m is as slow: at a source.
SLOW = 0.01
# Sides of an ellipse.
SIDES = 64


def fences_around_zeros(field: GuidingField) -> list[Fence]:
    """Returns fences around saddles, and around zeros from which robots spiral away.

    Args:
        field: The field, in the plane.
    """
    try:
        zeros = find_guiding_zeros(field).zeros
    except ConfigurationError:
        # m vanishes along a line: no fence is laid, and nothing is claimed.
        return []
    found = []
    for zero in zeros:
        place = field.cloud.normalize(zero.point)
        jacobian = field.cloud.unit_length * field.value_and_jacobian(zero.point[None])[1][0]
        # Those of a saddle are real, but NumPy may hold them as complex numbers.
        rates, directions = (one.real for one in np.linalg.eig(jacobian))
        if zero.kind == "focus" and rates.min() > 0:
            found.append(_around_focus(place, jacobian))
        elif zero.kind == "saddle":
            found.append(_around_saddle(field, place, directions[:, np.argmin(rates)]))
    return found


def fence_upstream(field: GuidingField, place: FloatArray) -> Fence | None:
    """Returns a fence around the line along which robots come to a place, which they leave.

    None where m hardly moves them.

    Args:
        field: The field, in the plane.
        place: (2,) normalised.
    """
    rate = rate_of(field)
    if np.linalg.norm(rate(0.0, place)) <= SLOW:
        return None
    left, right = _both_sides(rate, _backwards(rate, place, SLOW))
    return Fence.through(np.concatenate([right, left[::-1]]))


def _around_focus(focus: FloatArray, jacobian: FloatArray) -> Fence:
    """Returns an ellipse that robots cross outward near a focus, where that is unstable."""
    # The one with Q J + J' Q = 2 I.
    Q = solve_continuous_lyapunov(jacobian.T, 2 * np.eye(2))
    root_of_Q = sqrtm(Q / np.sqrt(np.linalg.det(Q))).real
    angles = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    circle = NEAR * np.column_stack([np.cos(angles), np.sin(angles)])
    return Fence.through(focus + np.linalg.solve(root_of_Q, circle.T).T)


def _around_saddle(field: GuidingField, saddle: FloatArray, come: FloatArray) -> Fence:
    """Returns the fence around a saddle, to which robots come in this direction."""
    rate, sides = rate_of(field), []
    for way in (come, -come):
        start = saddle + STEP * way
        line = _backwards(rate, start, float(np.linalg.norm(rate(0.0, start))) / 2)
        left, right = _both_sides(rate, np.concatenate([saddle[None], line]))
        # The left of the one way begins where the right of the other does.
        sides += [right, left[:0:-1]]
    return Fence.through(np.concatenate(sides))


def _backwards(rate: Rate, start: FloatArray, slow: float) -> FloatArray:
    """Returns points (n, 2) of the orbit that leads to a start, from there backwards.

    Args:
        rate: m.
        start: (2,) normalised.
        slow: It begins where m is slower: at a source.
    """

    def back(t: float, z: FloatArray) -> FloatArray:
        m = rate(t, z)
        return -m / np.linalg.norm(m)

    def ends(t: float, z: FloatArray) -> float:
        return float(min(HALF + 2 * STEP - np.abs(z).max(), np.linalg.norm(rate(t, z)) - slow))

    ends.terminal = True  # type: ignore[attr-defined]
    run = solve_ivp(back, (0, LONGEST), start, events=ends, dense_output=True, **PRECISION)
    return np.asarray(run.sol(np.linspace(0, run.t[-1], int(run.t[-1] / STEP) + 2)).T)


def _both_sides(rate: Rate, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns points (n, 2) on the left and on the right of a line (n, 2); see `_beside`."""
    onward = np.gradient(line, axis=0)
    onward /= np.linalg.norm(onward, axis=1, keepdims=True)
    return _beside(rate, line, onward, 1.0), _beside(rate, line, onward, -1.0)


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
