"""Proposes tubes: an orbit is integrated, and given sections as wide as m lets them be.

Along an orbit, with a frame E normal to it that turns no more than it must, displacements obey
y' = G y to first order, with G = E^T J E.  So a box |y_j| <= w_j whose half-widths solve
w' = |G| w + e, with the absolute values of G off its diagonal, is entered on every side at the
speed e: with one number e, the inflow, the tube is as wide everywhere as m holds it together.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm, logm, null_space
from scipy.sparse import block_diag, eye_array
from scipy.sparse.linalg import spsolve

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.tube import Tube, TubeProof, prove_tube
from sgvf_drake.fields import GuidingField

# Of the integration: the relative and absolute tolerance, and the longest step, in time at
# |m| = 1, so that no passage of a plane is missed.
TOLERANCE, LONGEST_STEP = 1e-9, 0.1
# A return to within this is looked at, in U, and one to within `CLOSED` ends the search.
NEAR, CLOSED = 0.2, 1e-7
# An orbit is given so many laps to settle, each of so many times the length of the piece.
LAPS, LONGEST_LAP = 6, 3.0
# Step at which the field is looked at along an orbit.
FINE = 1 / 128


@dataclass(frozen=True, eq=False)
class Orbit:
    """A solution of z' = m(z), in normalised units.

    Attributes:
        at: From times (n,) to points (n, d).
        duration: Of a lap, or until the vehicle rests.
        closed: Whether it is periodic.
    """

    at: Callable[[FloatArray], FloatArray]
    duration: float
    closed: bool


def closed_orbit(field: GuidingField, start: FloatArray, length: float) -> Orbit | None:
    """Returns the closed orbit on which m settles.

    Args:
        field: m.
        start: (d,) where to start, normalised.
        length: About the time of a lap.

    Returns:
        The orbit; None if m does not settle on one.
    """
    place = _run(field, start, length).y[:, -1]
    for _ in range(LAPS):
        plane, normal = place, field(field.cloud.denormalize(place))

        def passed(_: float, z: FloatArray) -> float:
            off = z - plane  # noqa: B023
            return float(off @ normal) if off @ off < NEAR**2 else -1.0  # noqa: B023

        run = _run(field, place, LONGEST_LAP * length, passed)
        place = run.y[:, -1]
        gap = plane - place
        if run.status != 1 or gap @ gap > NEAR**2 / 4:
            return None
        if np.abs(gap).max() < CLOSED:
            duration, solution = float(run.t[-1]), run.sol
            return Orbit(
                lambda t: solution(t).T + t[:, None] / duration * gap, duration, closed=True
            )
    return None
