"""Courses: itineraries on the network of a directed field, as a vehicle flies them."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
import math
from typing import Any, NamedTuple

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import NetworkField
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator, NavigatorState
from sgvf_drake.paths.planning import connection

STEP = 0.125
"""A place on an edge is looked for in steps of this part of the memory length."""

KEPT_WAYS = 32
"""Ways from an edge to a course that are kept."""


class Spot(NamedTuple):
    """A place on a course.

    Attributes:
        section: The section, which laps count on; see `NavigatorState`.
        arc: The arc length in m, which laps count on.
    """

    section: int
    arc: float


@dataclass(frozen=True, eq=False)
class Course:
    """An itinerary on the network of a directed field, with its automaton.

    Attributes:
        itinerary: The itinerary, in m.
        memory_length: That of the field, in m.
    """

    itinerary: Itinerary
    memory_length: float

    @classmethod
    def Of(cls, field: NetworkField, itinerary: Itinerary) -> "Course":
        """Returns the course of a field along an itinerary on its network."""
        return cls(itinerary, field.memory_length)

    def __deepcopy__(self, memo: Any) -> "Course":
        """Returns itself: nothing of it ever changes."""
        return self

    @cached_property
    def navigator(self) -> Navigator:
        """Its automaton."""
        return Navigator(self.itinerary, self.memory_length)

    @property
    def edges(self) -> tuple[int, ...]:
        """The numbers of its edges."""
        return self.itinerary.edges

    @cached_property
    def _edge_of_section(self) -> IntArray:
        begins = [section.begin for section in self.navigator.sections]
        return self.itinerary.edge_at(np.array(begins))

    def Start(self, position: FloatArray, direction: FloatArray | None = None) -> Spot:
        """Returns the place nearest to a position (d,), of near strands that along (d,)."""
        heading = None if direction is None or not direction.any() else direction[None]
        return _Spot(self.navigator.start(position[None], heading))

    def At(self, arc: float) -> Spot:
        """Returns the place at an arc length in m."""
        return _Spot(self.navigator.at(np.array([arc], np.float64)))

    def OnEdge(self, index: int, position: FloatArray) -> Spot:
        """Returns the place on the edge of an index nearest to a position (d,)."""
        begin, end = np.append(self.itinerary.starts, self.itinerary.length)[index : index + 2]
        count = math.ceil((end - begin) / (STEP * self.memory_length))
        # Not the end, where the next edge begins.
        arcs = np.linspace(begin, end, count, endpoint=False)
        distance = np.linalg.norm(self.itinerary.line.at(arcs) - position, axis=1)
        return self.At(float(arcs[distance.argmin()]))

    def Advance(self, spot: Spot, position: FloatArray) -> Spot:
        """Returns the place of a vehicle that has moved on to a position (d,)."""
        return _Spot(self.navigator.advance(_State(spot), position[None]))

    def Direction(self, spot: Spot) -> FloatArray:
        """Returns the intended direction (d,); zero at the end of an open course."""
        return self.navigator.direction(_State(spot))[0]

    def IsCompleted(self, spot: Spot) -> bool:
        """Whether an open course is at its end; a closed one never is."""
        return not self.itinerary.closed and spot.section >= len(self.navigator.sections)

    def Index(self, spot: Spot) -> int:
        """Returns the place in `edges` of the edge in use."""
        count = len(self._edge_of_section)
        closed = self.itinerary.closed
        return int(
            self._edge_of_section[
                spot.section % count if closed else min(spot.section, count - 1)
            ]
        )

    def Following(self, index: int) -> int | None:
        """Returns the edge that follows the one of an index; None if the course ends there."""
        if index + 1 < len(self.edges):
            return self.edges[index + 1]
        return self.edges[0] if self.itinerary.closed else None

    def Headings(self, arcs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the headings (n, d) of a vehicle at arc lengths (n,), and how they turn.

        A heading turns to the intended direction g by dh/ds = (g - h) / memory length; on a
        closed course it has done so since the lap before.

        Args:
            arcs: In m, of one lap.
        """
        sections = self.navigator.sections
        begins = np.array([section.begin for section in sections])
        intended = np.array([section.direction for section in sections])
        left = np.exp([(s.begin - s.end) / self.memory_length for s in sections])
        h = intended[0]
        for _ in range(1 + self.itinerary.closed):
            first = []
            for g, share in zip(intended, left, strict=True):
                first.append(h)
                h = g + share * (h - g)
        at = np.searchsorted(begins, arcs, side="right") - 1
        g, share = intended[at], np.exp((begins[at] - arcs) / self.memory_length)[:, None]
        behind = share * (np.array(first)[at] - g)
        return g + behind, -behind / self.memory_length


@lru_cache(KEPT_WAYS)
def Detour(course: Course, first: int, second: int, rejoin: int) -> Course:
    """Returns the open course from an edge to one of another course, the shortest way.

    Args:
        course: The other course.
        first: The number of the edge in use.
        second: That of the edge that follows it; 0: what is shortest.
        rejoin: The place in the edges of the course of the last edge; -1: it ends at the
            second.

    Raises:
        ConfigurationError: If the edge that it is to lead to cannot be reached.
    """
    network = course.itinerary.network
    edges = [first, second] if second else [first]
    if rejoin >= 0:
        last = course.edges[rejoin]
        way = connection(network, edges[-1], [last])
        if not way:
            raise ConfigurationError(f"edge {last} cannot be reached from edge {first}")
        edges += way[1:]
    return Course(Itinerary.along(edges, network, closed=False), course.memory_length)


def _Spot(state: NavigatorState) -> Spot:
    return Spot(int(state.section[0]), float(state.arc[0]))


def _State(spot: Spot) -> NavigatorState:
    arc = np.array([spot.arc])
    return NavigatorState(np.array([spot.section]), arc, arc)
