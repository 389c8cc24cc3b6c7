"""Tells agents the intended direction along an itinerary, from where they are."""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.sections import KAPPA, Section, is_end, sections

SAMPLING = 0.25
"""Distance of the samples of the line, in sigma."""

BEHIND, AHEAD = 1.0, 6.0
"""An agent is looked for from this far behind its last place to this far ahead, in sigma."""

TIE = 1.5
"""The heading chooses among strands whose squared distances, in sigma, differ by no more than
the square of this: a field attracts by squared distances."""

FIRST = SAMPLING
"""The first of several strands is taken whose distances differ by less than this, in sigma, as
those of an edge that is travelled twice."""


class NavigatorState(NamedTuple):
    """Where agents are on an itinerary.

    Attributes:
        section: (n,) the section, which laps count on; the one behind the last, of an open
            itinerary, says that it is completed.
        arc: (n,) the arc length, which laps count on.
        begin: (n,) the arc length at which they started.
    """

    section: IntArray
    arc: FloatArray
    begin: FloatArray


class NavigatorTables(NamedTuple):
    """What a navigator looks things up in, lengths in the unit of the itinerary.

    Attributes:
        samples: (N, d) points on the line at equal steps of arc length.
        spacing: The step.
        num_looked_at: How many samples from the first one on are looked at in a step.
        guards: (S,) the arc length at which each section ends.
        directions: (S + 1, d) the intended direction in each section, and zero.
        floors: (S + 1,) the least arc length at which an agent in a section is looked for.
        ceilings: (S + 1,) the largest one.
        behind: How far behind its last place an agent is looked for.
        ahead: How far ahead of it.
        lost: The distance from its place beyond which an agent is started anew.
    """

    samples: FloatArray
    spacing: float
    num_looked_at: int
    guards: FloatArray
    directions: FloatArray
    floors: FloatArray
    ceilings: FloatArray
    behind: float
    ahead: float
    lost: float


class Navigator:
    """The automaton of the sections of an itinerary, for agents in batches.

    A section is never left backwards, so noise does not run to and fro over a guard.  The place
    of an agent on the line is looked for about its last one, so it does not change to another
    strand where the line crosses itself.

    Args:
        itinerary: The itinerary.
        sigma: The scale of the field, in the unit of the itinerary.
        kappa: That of the field.
        lag: How far an agent moves until its heading has followed; see `sections`.
        step: How far an agent moves at most between two calls.

    Raises:
        ConfigurationError: If sigma or kappa is not positive, or the lag negative.
    """

    def __init__(
        self,
        itinerary: Itinerary,
        sigma: float,
        kappa: float = KAPPA,
        lag: float | None = None,
        step: float = 0.0,
    ) -> None:
        self.itinerary = itinerary
        self.sections: tuple[Section, ...] = sections(itinerary, sigma, kappa, lag)
        self._sigma, self._closed = sigma, itinerary.closed
        self._length, self._lost = itinerary.length, itinerary.network.unit_length
        self._sample(max(math.ceil(self._length / (SAMPLING * sigma)), 4))
        self._behind, self._ahead = BEHIND * sigma, AHEAD * sigma + step
        reach = math.ceil((self._ahead + self._behind) / self._spacing)
        self._window = np.arange(reach + 2)
        self._guards = np.array([section.end for section in self.sections])
        directions = np.array([section.direction for section in self.sections])
        # Behind the last section of an open itinerary agents are to rest.
        self._directions = np.concatenate([directions, np.zeros_like(directions[:1])])
        self._floor, self._ceiling = self._bounds()

    @property
    def tables(self) -> NavigatorTables:
        """What it looks things up in, for its like in other languages."""
        return NavigatorTables(
            self._points,
            self._spacing,
            len(self._window),
            self._guards,
            self._directions,
            self._floor,
            self._ceiling,
            self._behind,
            self._ahead,
            self._lost,
        )

    def start(self, x: FloatArray, h: FloatArray | None = None) -> NavigatorState:
        """Returns the state of agents at the nearest places of the line.

        Args:
            x: (n, d) positions.
            h: (n, d) headings; of strands that are as near, the one along it is taken.
        """
        distance = self._distances(x)
        cost = distance + FIRST / self._length * self._arcs
        if h is not None:
            near = distance**2 <= distance.min(axis=1, keepdims=True) ** 2 + TIE**2
            # It outweighs what the distances of near strands differ by.
            along = 2 * TIE * (h @ self._tangents.T)
            cost = np.where(near, cost - along, np.inf)
        arc = self._refined(x, np.argmin(cost, axis=1))
        arc = arc % self._length if self._closed else np.clip(arc, 0, self._length)
        return NavigatorState(self._section_at(arc), arc, arc.copy())

    def at(self, arc: FloatArray) -> NavigatorState:
        """Returns the state of agents at arc lengths (n,) of the itinerary."""
        return NavigatorState(self._section_at(arc), arc, arc.copy())

    def advance(self, state: NavigatorState, x: FloatArray) -> NavigatorState:
        """Returns the state of agents that have moved on to `x` (n, d).

        An agent farther than U from its place is started anew at the nearest place ahead.
        """
        lap, place = divmod(state.section, len(self.sections))
        if not self._closed:
            lap, place = 0 * lap, state.section
        passed = lap * self._length
        lower = np.maximum(state.arc - self._behind, self._floor[place] + passed)
        upper = np.minimum(state.arc + self._ahead, self._ceiling[place] + passed)
        sample = (lower / self._spacing).astype(np.intp)[:, None] + self._window
        offset = x[:, None] - self._points[self._wrapped(sample)]
        squared = np.einsum("nkd,nkd->nk", offset, offset)
        squared[sample > (upper / self._spacing)[:, None] + 1] = np.inf
        rows = np.arange(len(x))
        best = np.argmin(squared, axis=1)
        arc = self._refined(x, sample[rows, best])
        arc = np.minimum(np.maximum(arc, lower), upper)
        section = np.maximum(state.section, self._section_at(arc))
        lost = squared[rows, best] > self._lost**2
        if lost.any():
            arc[lost] = self._anew(x[lost], state.arc[lost])
            section[lost] = self._section_at(arc[lost])
        return NavigatorState(section, arc, state.begin)

    def direction(self, state: NavigatorState) -> FloatArray:
        """The intended directions (n, d); zero where an open itinerary is completed."""
        if self._closed:
            return self._directions[state.section % len(self.sections)]
        return self._directions[state.section]

    def completed(self, state: NavigatorState) -> IntArray:
        """The laps (n,) since the start; 1 where an open itinerary is completed."""
        if self._closed:
            laps = ((state.arc - state.begin) / self._length).astype(np.intp)
            return np.maximum(laps, 0)
        return state.section // len(self.sections)

    def _sample(self, count: int) -> None:
        """Takes samples at equal steps of arc length, and the tangents there."""
        self._points = self.itinerary.line.sample(count + (not self._closed))
        self._spacing = self._length / count
        self._arcs = self._spacing * np.arange(len(self._points))
        around = np.arange(-1, len(self._points) + 1)
        neighbours = self._points[self._wrapped(around)]
        # Zero where the line turns round, for there no place is better than its end.
        tangents = (neighbours[2:] - neighbours[:-2]) / (2 * self._spacing)
        if not self._closed:
            tangents[[0, -1]] *= 2
        self._tangents = tangents

    def _wrapped(self, sample: IntArray) -> IntArray:
        """The numbers of samples beyond the ends of the line, on the line."""
        count = len(self._points)
        return sample % count if self._closed else np.clip(sample, 0, count - 1)

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        """Between which arc lengths an agent in each section is looked for.

        Where the line turns round, it runs to and fro along one edge: before the turn only its
        first strand is looked at, and from the turn on only its second.
        """
        it = self.itinerary
        ends = np.append(it.starts[1:], it.length)
        lengths = np.diff(ends, prepend=0.0)
        floor, ceiling = [], []
        for number, section in enumerate(self.sections):
            edge = int(it.edge_at(section.begin))
            back_at = self._turns_round(number)
            floor.append(section.begin - self._behind if back_at is None else back_at)
            passes = section.node is not None and (self._closed or edge + 1 < len(ends))
            following = lengths[(edge + 1) % len(ends)] if passes else 0.0
            ceiling.append(ends[edge] + following)
        if not self._closed:
            floor = [max(arc, 0.0) for arc in floor]
        return np.array([*floor, floor[-1]]), np.array([*ceiling, it.length])

    def _turns_round(self, number: int) -> float | None:
        """The arc length of the end at which a section turns round, if it does."""
        section = self.sections[number]
        if not section.turns:
            return None
        if is_end(self.itinerary, section.node):
            return section.end
        before = self.sections[number - 1].node
        return (
            section.begin if section.node is None and is_end(self.itinerary, before) else None
        )

    def _distances(self, x: FloatArray) -> FloatArray:
        """The distances (n, N) of agents from all samples, in sigma."""
        return cdist(x, self._points) / self._sigma

    def _refined(self, x: FloatArray, sample: IntArray) -> FloatArray:
        """The arc lengths of the feet (n,) of agents on the tangents at samples."""
        on_line = self._wrapped(sample)
        offset = x - self._points[on_line]
        ahead = (offset * self._tangents[on_line]).sum(axis=1)
        half = self._spacing / 2
        return sample * self._spacing + np.minimum(np.maximum(ahead, -half), half)

    def _section_at(self, arc: FloatArray) -> IntArray:
        """The section (n,) that begins at or before an arc length."""
        if not self._closed:
            return np.searchsorted(self._guards, arc, side="right")
        lap = np.floor(arc / self._length)
        number = np.searchsorted(self._guards, arc - lap * self._length, side="right")
        return lap.astype(np.intp) * len(self.sections) + number

    def _anew(self, x: FloatArray, arc: FloatArray) -> FloatArray:
        """The arc lengths of agents that are far from their place: of the nearest ahead.

        On a closed line more than half a lap ahead is behind: no lap counts that was not made.
        """
        ahead = self._arcs - arc[:, None]
        if self._closed:
            ahead = (ahead + self._lost) % self._length - self._lost
        cost = self._distances(x) + FIRST / self._length * ahead
        best = np.argmin(np.where(ahead >= -self._lost, cost, np.inf), axis=1)
        moved = ahead[np.arange(len(x)), best] + self._refined(x, best) - self._arcs[best]
        if self._closed:
            moved = np.where(moved > self._length / 2, moved - self._length, moved)
        return arc + moved
