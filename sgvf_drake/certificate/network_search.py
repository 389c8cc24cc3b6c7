"""Proposes disks across the edges of a network, and legs between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.leg_search import (
    HALF_WIDTH,
    IN_TURNS,
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
UNREACHED = "no robot comes to where its first disk, or its last one, has to be"


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
        if place.after is None and start is not None:
            return self._end(cut, start)
        if start is None or end is None:
            guard = cut.guards[-1 if place.index is None else place.index]
            where = self._normalised(cut, guard)
            return Obstacle(UNREACHED, tuple(where.tolist()))
        if place.index is not None:
            return self._chain([(cut.directions[place.index], start, end)])
        entry = self.automaton.edges[place.after].entry
        guard = self.automaton.turns[place.before, place.after]
        if guard == cut.guards[-1]:
            return self._chain([(entry, start, end)])
        middle = self._next(cut, cut.last, middle_of(start), guard, entry)
        if middle is None:
            return Obstacle(UNREACHED, tuple(self._normalised(cut, guard).tolist()))
        return self._chain([(cut.last, start, middle), (entry, middle, end)])

    def _chain(
        self, wanted: Sequence[tuple[FloatArray, Disk, Disk]]
    ) -> list[ProvedLeg] | Obstacle:
        """Returns the legs at some directions between disks, or why one was not found."""
        legs = []
        for direction, start, end in wanted:
            found = find_leg(self.field.heading(direction), start, end, NEAR * self.field.sigma)
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
            guard, disk = kept[-1] + 1, None
            soon = cut.guards[kept[-1]] + EXIT * self.field.memory_length
            if disks[-1] is not None:
                middle = middle_of(disks[-1])
                for ahead in range(guard, 1 + len(cut.directions)):
                    if ahead > guard and cut.guards[ahead - 1] > soon:
                        break
                    disk = self._next(cut, cut.directions[ahead - 1], middle, cut.guards[ahead])
                    if disk is not None:
                        guard = ahead
                        break
            if disk is None:
                disk = self._first(cut, cut.directions[guard - 1], cut.guards[guard])
            kept.append(guard)
            disks.append(disk)
        return EdgeDisks(cut.number, tuple(kept), tuple(disks))

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
