"""Proposes disks across the edges of a network, and legs between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.leg_search import (
    HALF_WIDTH,
    IN_TURNS,
    MISSES,
    NEAR,
    Obstacle,
    disk_at,
    find_end,
    find_leg,
    middle_of,
)
from sgvf_drake.certificate.legs import Disk, ProvedLeg
from sgvf_drake.certificate.network import EdgeDisks, Place, automaton_of
from sgvf_drake.certificate.trajectories import passing_orbit
from sgvf_drake.fields import DirectedField
from sgvf_drake.paths.automaton import Automaton, EdgeCut
from sgvf_drake.paths.sections import EXIT

# How far before a disk an orbit comes to the path whose middle it shares, in noise levels.
RUN_IN = 2.5
# The cosine of the change of m at a guard from which on robots turn round there.
ROUND = -0.5
# Of a place that no robot comes to.
UNREACHED = "no robot comes to where its first disk has to be"


@dataclass(frozen=True, eq=False)
class NetworkSearch:
    """What looks for the legs of all sections and turns.

    Attributes:
        field: The field.
    """

    field: DirectedField

    @cached_property
    def automaton(self) -> Automaton:
        """The network, cut at the guards that robots pass."""
        return automaton_of(self.field, self.disks)

    @cached_property
    def disks(self) -> tuple[EdgeDisks, ...]:
        """The disks at the guards of every edge, about the orbits that come there."""
        whole = Automaton.of(self.field.network, self.field.memory_length)
        return tuple(map(self._disks_of, whole.edges.values()))

    def find(self, place: Place) -> list[ProvedLeg] | Obstacle:
        """Returns legs from the first disk of a section or a turn to the last.

        Or what is in the way, in the unit of the waypoints.
        """
        found = self._find(place)
        if isinstance(found, Obstacle):
            where = self.field.cloud.denormalize(np.array([found.place]))[0]
            return Obstacle(found.reason, tuple(where.tolist()))
        return found

    def _find(self, place: Place) -> list[ProvedLeg] | Obstacle:
        start, end = place.between(self.disks)
        cut = self.automaton.edges[place.before]
        if start is None:
            guard = cut.guards[-1 if place.index is None else place.index]
            return Obstacle(UNREACHED, tuple(self._normalised(cut, guard).tolist()))
        if place.after is None:
            return self._end(cut, start)
        if place.index is not None:
            goal = self._normalised(cut, cut.guards[place.index + 1])
            return self._chain([(cut.directions[place.index], start, end, goal)])
        ahead = self.automaton.edges[place.after]
        goal = self._normalised(ahead, ahead.guards[0])
        guard = self.automaton.turns[place.before, place.after]
        if guard == cut.guards[-1]:
            return self._chain([(ahead.entry, start, end, goal)])
        middle = self._next(cut, cut.last, middle_of(start), guard, ahead.entry)
        first = (cut.last, start, middle, self._normalised(cut, guard))
        if middle is None:
            return self._chain([first])
        return self._chain([first, (ahead.entry, middle, end, goal)])

    def _chain(
        self, wanted: Sequence[tuple[FloatArray, Disk, Disk | None, FloatArray]]
    ) -> list[ProvedLeg] | Obstacle:
        """Returns legs, or why one was not found.

        Args:
            wanted: The intended direction of each, the disk in which it begins, that in which
                it ends, if there is one, and the point of the path there, normalised.
        """
        legs, near = [], NEAR * self.field.sigma
        for direction, start, end, goal in wanted:
            held = self.field.heading(direction)
            if end is None:
                middle = middle_of(start)
                orbit, _ = passing_orbit(held, middle, goal, goal - middle, near)
                return Obstacle(MISSES, tuple(orbit.end.tolist()))
            found = find_leg(held, start, end, near)
            if isinstance(found, Obstacle):
                return found
            legs.append(found)
        return legs

    def _end(self, cut: EdgeCut, start: Disk) -> list[ProvedLeg] | Obstacle:
        line = self.automaton.line_of(cut.number, None, None)
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        found = find_end(
            self.field.heading(cut.last), start, float(length) / self.field.cloud.unit_length
        )
        return found if isinstance(found, Obstacle) else [found]

    def _disks_of(self, cut: EdgeCut) -> EdgeDisks:
        """Returns the disks at the guards of an edge that robots pass; None where none come.

        At a sharp bend a robot may be led past a guard that follows soon.  There, the direction
        behind that one is the intended one at once.
        """
        kept, disks = [0], [self._first(cut, cut.entry, cut.guards[0])]
        while kept[-1] < len(cut.directions):
            guard, disk = self._ahead(cut, kept[-1], disks[-1])
            kept.append(guard)
            disks.append(disk)
        return EdgeDisks(cut.number, tuple(kept), tuple(disks))

    def _ahead(self, cut: EdgeCut, guard: int, disk: Disk | None) -> tuple[int, Disk | None]:
        """Returns the next guard that robots from the disk of a guard pass, and its disk.

        Where they pass none, it is the one that follows, for robots from the path.
        """
        soon = cut.guards[guard] + EXIT * self.field.memory_length
        for ahead in range(guard + 1, len(cut.guards)):
            if disk is None or (ahead > guard + 1 and cut.guards[ahead - 1] > soon):
                break
            direction = cut.directions[ahead - 1]
            found = self._next(cut, direction, middle_of(disk), cut.guards[ahead])
            if found is not None:
                return ahead, found
        return guard + 1, self._first(cut, cut.directions[guard], cut.guards[guard + 1])

    def _first(self, cut: EdgeCut, direction: FloatArray, guard: float) -> Disk | None:
        """Returns the disk at a guard, for robots from the path some way before."""
        start = self._normalised(cut, guard - RUN_IN * self.field.memory_length)
        return self._next(cut, direction, start, guard)

    def _next(
        self,
        cut: EdgeCut,
        direction: FloatArray,
        start: FloatArray,
        guard: float,
        behind: FloatArray | None = None,
    ) -> Disk | None:
        """Returns the disk at a guard, for robots that come from a place before.

        Its normal is m; or, with a direction that is intended behind it, halfway from that to m
        there, so that robots come and leave through it; except where they turn round.
        """
        held, sigma = self.field.heading(direction), self.field.sigma
        place = self._normalised(cut, guard)
        normal = place - self._normalised(cut, guard - self.field.memory_length)
        orbit, passes = passing_orbit(held, start, place, normal, NEAR * sigma)
        if not passes:
            return None
        point = self.field.cloud.denormalize(orbit.end)
        m = held(point)
        if behind is None:
            return disk_at(orbit.end, m, HALF_WIDTH * sigma)
        onward = self.field(point, behind)
        normal = m + onward if m @ onward > ROUND * (m @ m) else m
        return disk_at(orbit.end, normal, IN_TURNS * sigma)

    def _normalised(self, cut: EdgeCut, arc: float) -> FloatArray:
        return self.field.cloud.normalize(cut.at(arc)[None])[0]
