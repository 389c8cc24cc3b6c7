"""The branches of a path: its pieces, as a vehicle flies from one to another."""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field
from sgvf_drake.paths import PointCloud, TreeReference, trace_pieces
from systems.guidance import FieldForSpeed
from systems.transfer import Motion, PlanTransfer

MAX_DEPARTURES = 20
"""Places on a branch from which a departure is tried, and entries that are tried for each."""

BRAKING_SHARE = 0.3
"""Share of the greatest acceleration that brakes ahead of a turn; the turn takes the rest."""

ENTRY_SHARE = 0.1
"""Share of an open branch, from its start, in which a vehicle enters it from elsewhere."""


class Branch(NamedTuple):
    """One piece of a path.

    Attributes:
        points: Waypoints on it, (n, d) in m, in the order of travel.
        length: In m.
        closed: Whether it is a loop, which may be entered anywhere and flown for ever.
    """

    points: FloatArray
    length: float
    closed: bool

    def Nearest(self, position: FloatArray) -> tuple[int, float]:
        """Returns the waypoint nearest to a position (d,), and its distance in m."""
        offset = self.points - position
        squares = np.einsum("ij,ij->i", offset, offset)
        nearest = int(squares.argmin())
        return nearest, math.sqrt(squares[nearest])

    def Entries(self, field: Field, speed: float, anywhere: bool = False) -> Motion:
        """Returns how a vehicle moves along the field at the waypoints where it may enter.

        Args:
            field: The guiding field, in metres; taken as it is flown, see `FieldForSpeed`.
            speed: In m/s.
            anywhere: Whether an open branch may be entered elsewhere than at its start.
        """
        points = self.points
        if not (self.closed or anywhere):
            points = points[: max(1, round(ENTRY_SHARE * len(points)))]
        return MotionAlong(field, points, speed)


def MotionAlong(field: Field, points: FloatArray, speed: float) -> Motion:
    """Returns the motion (n, d) of vehicles that follow a field exactly at points (n, d)."""
    m, J = FieldForSpeed(field, speed).value_and_jacobian(points)
    return Motion(points, speed * m, speed**2 * np.einsum("nij,nj->ni", J, m))


def MakeBranches(field: Field, points: FloatArray) -> tuple[Branch, ...]:
    """Returns the pieces of a cloud of waypoints, longest first, without stray points.

    Pieces shorter than one U, `PointCloud.unit_length`, are strays.

    Args:
        field: The guiding field; it tells the direction of travel of open pieces, and a
            learned one which pieces are open: those at whose ends it comes to rest.
        points: The waypoints, (n, d) in m: of a learned field, `field.cloud.points`.
    """
    unit = PointCloud(points).unit_length
    tree = TreeReference(points, tuple(trace_pieces(points)))
    ends = getattr(field, "ends", np.empty((0, field.dim)))
    branches = []
    for piece in tree.opened_at(ends, unit).pieces:
        if len(piece.order) < 2 or piece.length < unit:
            continue
        ordered = points[piece.order]
        steps = np.diff(ordered, axis=0)
        if float(np.sum(field(ordered[:-1]) * steps)) < 0.0:
            ordered = ordered[::-1]
        branches.append(Branch(ordered, piece.length, piece.closed))
    return tuple(branches)


def SpeedLimits(
    field: Field, branch: Branch, speed: float, max_acceleration: float
) -> FloatArray:
    """Returns the speeds (n,) in m/s at which a vehicle can pass the waypoints of a branch.

    At each, speed^2 |J m| keeps the acceleration; and before a turn the speed falls no
    faster than `BRAKING_SHARE` of the acceleration allows (the backward pass of
    time-optimal path parametrisation).

    Args:
        field: The guiding field, in metres.
        branch: The branch.
        speed: The commanded speed in m/s, positive; nowhere is the result above it.
        max_acceleration: In m/s^2.
    """
    demand = np.linalg.norm(MotionAlong(field, branch.points, speed).acceleration, axis=1)
    limits = speed * np.sqrt(np.minimum(1.0, max_acceleration / np.maximum(demand, 1e-9)))
    steps = np.linalg.norm(np.roll(branch.points, -1, axis=0) - branch.points, axis=1)
    gains = 2.0 * BRAKING_SHARE * max_acceleration * steps
    last = len(limits) - 1
    # Twice around a loop: the turn may lie behind its first waypoint.
    backward = [*range(last, -1, -1)] * 2 if branch.closed else range(last - 1, -1, -1)
    for i in backward:
        ahead = limits[(i + 1) % len(limits)]
        limits[i] = min(limits[i], math.sqrt(ahead**2 + gains[i]))
    return limits


def DepartureDelay(
    field: Field,
    branch: Branch,
    target: Branch,
    position: FloatArray,
    speed: float,
    max_acceleration: float,
) -> float:
    """Returns how long in s a vehicle best goes on along its branch before a transfer.

    A transfer that starts where the branch leads away from its target is long.  The delay
    is the one at which the transfer ends soonest and is gentle, waiting included; it is less
    than a lap.

    Args:
        field: The guiding field, in metres.
        branch: Where the vehicle is.
        target: Where it is to go.
        position: Its position, (d,) in m.
        speed: In m/s, positive.
        max_acceleration: In m/s^2; see `PlanTransfer`.
    """
    first, _ = branch.Nearest(position)
    ahead = branch.points[first:]
    if branch.closed:
        ahead = np.concatenate((ahead, branch.points[:first]))
    steps = np.linalg.norm(np.diff(ahead, axis=0), axis=1)
    delays = np.concatenate(([0.0], np.cumsum(steps))) / speed
    stride = -(-len(ahead) // MAX_DEPARTURES)
    ahead, delays = ahead[::stride], delays[::stride]
    departures = MotionAlong(field, ahead, speed)
    entries = target.Entries(field, speed)
    stride = -(-len(entries.position) // MAX_DEPARTURES)
    entries = Motion(*(values[::stride] for values in entries))
    plans = [
        PlanTransfer(Motion(*start), entries, speed, max_acceleration)
        for start in zip(*departures, strict=True)
    ]
    violations = np.array([plan.violation for plan in plans])
    costs = delays + [plan.cost for plan in plans]
    return float(delays[np.argmin(np.where(violations == violations.min(), costs, np.inf))])


def CheckBranches(
    branches: Sequence[Branch], dim: int, box: tuple[FloatArray, FloatArray] | None
) -> None:
    """Raises ConfigurationError unless a vehicle can be sent to each of the branches.

    Args:
        branches: The branches.
        dim: The dimension d of the field.
        box: Lower and upper corner (d,) of where the field holds, in m; None: everywhere.
    """
    if not branches:
        raise ConfigurationError("a supervisor needs at least one branch")
    for number, branch in enumerate(branches):
        points = np.asarray(branch.points)
        if points.ndim != 2 or points.shape[1] != dim or not len(points):
            raise ConfigurationError(
                f"branch {number} must have points (n, {dim}), got {points.shape}"
            )
        if not np.isfinite(points).all():
            raise ConfigurationError(f"branch {number} has a point that is not finite")
        if not (np.isfinite(branch.length) and branch.length > 0.0):
            raise ConfigurationError(
                f"the length of branch {number} must be positive, got {branch.length}"
            )
        if box is not None and not ((points >= box[0]) & (points <= box[1])).all():
            raise ConfigurationError(f"branch {number} is not inside the box")


def CheckedBox(
    box: tuple[ArrayLike, ArrayLike] | None, dim: int
) -> tuple[FloatArray, FloatArray] | None:
    """Returns the corners of a box as arrays.

    Raises:
        ConfigurationError: if they are not two, (d,) each, the lower one first.
    """
    if box is None:
        return None
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    if lower.shape != (dim,) or upper.shape != (dim,) or not (lower < upper).all():
        raise ConfigurationError(
            f"box must be a lower and an upper corner ({dim},), got {lower} and {upper}"
        )
    return lower, upper


def CheckTour(tour: Sequence[int], num_branches: int) -> None:
    """Raises ConfigurationError unless there is a tour, of branches that exist."""
    if not len(tour) or any(stop not in range(num_branches) for stop in tour):
        raise ConfigurationError(
            f"tour must hold numbers of the {num_branches} branches, got {list(tour)}"
        )
