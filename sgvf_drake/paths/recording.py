"""What the order of the waypoints tells, where they were recorded along the path."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray

FEWEST_STEPS = 10

ONE_WAY = 0.95
"""Share of the way from each waypoint to the next that leads one way, if they are in order.

Of shuffled ones it is a half, and of a few dozen of them hardly ever more than this."""

LONGEST_STEP = 3.0
"""Longer steps count as this many median ones: they are jumps to the next demonstration."""

JUMP = 5.0
"""A recording goes on over a step of at most this many median ones; more is a jump."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Waypoints in the order of their file, seen along the routes that were found.

    Attributes:
        points: (N, d).
        route: (N,) the route that each is nearest to, -1 for strays.
        arc: (N,) its arc length on it.
        lengths: (R,) the length of each route.
        closed: (R,) whether it is closed.
    """

    points: FloatArray
    route: IntArray
    arc: FloatArray
    lengths: FloatArray
    closed: BoolArray

    def direction(self, route: int) -> int:
        """1 if the waypoints are in order along a route, -1 if against it, 0 if neither."""
        both = (self.route[:-1] == route) & (self.route[1:] == route)
        if both.sum() < FEWEST_STEPS:
            return 0
        step = np.diff(self.arc)[both]
        if self.closed[route]:
            half = self.lengths[route] / 2
            step = (step + half) % (2 * half) - half
        size = np.minimum(np.abs(step), LONGEST_STEP * np.median(np.abs(step)))
        forward = float(size[step > 0].sum() / max(size.sum(), 1e-300))
        return 1 if forward >= ONE_WAY else -1 if forward <= 1 - ONE_WAY else 0

    def ends(self, route: int) -> FloatArray:
        """The first and the last waypoint of a route in the order of the file, (2, d)."""
        own = np.flatnonzero(self.route == route)
        return self.points[own[[0, -1]]]

    def passes(self, route: int) -> float:
        """How many times the recording runs along a route; jumps count as single steps."""
        own = self.route == route
        step = np.linalg.norm(np.diff(self.points[own], axis=0), axis=1)
        way = np.minimum(step, LONGEST_STEP * np.median(step)).sum()
        return float(way / self.lengths[route])

    def links(self, reach: float) -> list["Link"]:
        """The ends of open routes that the recording joins, as it goes on without a jump.

        Args:
            reach: How near to an end the recording leaves a route.
        """
        # Of each waypoint the end that it is near, 0 or 1, if its route is open and in order.
        routes = range(len(self.lengths))
        recorded = [not self.closed[k] and self.direction(k) != 0 for k in routes]
        side = np.where(self.arc <= reach, 0, -1)
        side[self.arc >= self.lengths[self.route] - reach] = 1
        side[(self.route < 0) | ~np.array(recorded)[self.route]] = -1
        step = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        goes_on = (self.route[:-1] != self.route[1:]) & (step <= JUMP * np.median(step))
        return [
            Link(
                (int(self.route[k]), int(side[k])),
                (int(self.route[k + 1]), int(side[k + 1])),
                self.points[k : k + 2],
            )
            for k in np.flatnonzero(goes_on & (side[:-1] >= 0) & (side[1:] >= 0)).tolist()
        ]


@dataclass(frozen=True, eq=False)
class Link:
    """Two ends that a recording joins.

    Attributes:
        first: A route, and 0 for its start or 1 for its end.
        second: The same.
        points: The waypoints between which the recording goes on, (2, d).
    """

    first: tuple[int, int]
    second: tuple[int, int]
    points: FloatArray
