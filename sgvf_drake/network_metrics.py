"""How well agents followed a network: as `metrics`, and what they did at its nodes.

On a network the nearest edge is not always the one in use, and an agent may run along an edge
either way.  So what agents did is read off the edges whose middles they passed.
"""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.metrics import (
    END_DISTANCE,
    LEAVE_BOXES,
    REACH_DISTANCE,
    REST_SPAN,
    REST_WINDOW,
    SETTLE_DISTANCE,
    STALL_SPAN,
    STALL_WINDOW,
    since_last,
    spans_less,
)
from sgvf_drake.passages import (
    Passage,
    errors_in_use,
    passages,
    straight_fraction,
    turn_fraction,
)
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.itinerary import Itinerary

WAY_OFF = 1.0
"""On a network without a lap or an end, errors count from this many U after the first reach."""


@dataclass(frozen=True, eq=False)
class NetworkMetrics:
    """What agents did on a network, one value for each of n agents.

    Attributes:
        reached: Came within `REACH_DISTANCE` of the network.
        lapped: Ran along every edge of its closed path in order, within `SETTLE_DISTANCE`.
        ended: Came to rest at the end of its open path, in order from where it came to it.
        stalled: Hardly moved in the end, and not at an end.
        left: Was outside `LEAVE_BOXES` boxes.
        kind: What the piece that it is near in the end is: "closed path", "open path" or
            "network".
        rms: Root mean square of the distance from the edge in use: over the last lap, the way
            to the end, or, on a network, all the time since it came to it; NaN where it did
            not.
        maximum: The largest distance over the same time.
        first: The first sample of that time.
        until: The last one.
        errors: (T, n) the distances from the edges in use.
        straight_fraction: The part of the crossings driven straight over; None: none
            was passed.
        turn_fraction: The part of the nodes of the route left as it says; None: there
            is none, or none was passed.
    """

    reached: BoolArray
    lapped: BoolArray
    ended: BoolArray
    stalled: BoolArray
    left: BoolArray
    kind: list[str]
    rms: FloatArray
    maximum: FloatArray
    first: IntArray
    until: IntArray
    errors: FloatArray
    straight_fraction: float | None
    turn_fraction: float | None

    @property
    def followed(self) -> BoolArray:
        """Who did what the field is for: a lap, the way to the end, or to go on for ever."""
        on_network = np.array([kind == "network" for kind in self.kind])
        going = self.reached & ~self.stalled & ~self.left
        return np.asarray(self.lapped | self.ended | (on_network & going))

    @property
    def aim(self) -> str:
        """What that is, in words."""
        aims = {
            "closed path": "complete a lap",
            "open path": "come to rest at the end",
            "network": "stay on the network",
        }
        return " or ".join(aim for kind, aim in aims.items() if kind in self.kind)

    def summary(self) -> dict[str, float | None]:
        """Returns the fractions of agents and the errors, by the names of `summary.json`."""
        measured = np.isfinite(self.rms)
        rms = maximum = None
        if measured.any():
            rms = float(np.sqrt((self.rms[measured] ** 2).mean()))
            maximum = float(self.maximum[measured].max())
        return {
            "reach_fraction": float(self.reached.mean()),
            "lap_fraction": self._of("closed path", self.lapped),
            "end_fraction": self._of("open path", self.ended),
            "stall_fraction": float(self.stalled.mean()),
            "leave_fraction": float(self.left.mean()),
            "cross_track_rms": rms,
            "cross_track_max": maximum,
            "straight_fraction": self.straight_fraction,
            "turn_fraction": self.turn_fraction,
        }

    def _of(self, kind: str, done: BoolArray) -> float | None:
        on_it = np.array([own == kind for own in self.kind])
        return float(done[on_it].mean()) if on_it.any() else None


def network_metrics(
    times: FloatArray,
    positions: FloatArray,
    network: PathNetwork,
    box: tuple[FloatArray, FloatArray],
    ends: FloatArray,
    route: Itinerary | None = None,
) -> NetworkMetrics:
    """Measures agents that moved at unit speed.

    Args:
        times: (T,) increasing.
        positions: (T, n, d), in the unit of the network.
        network: The network.
        box: Lower and upper corner (d,).
        ends: (E, d) where the field comes to rest.
        route: What the agents were to follow; None: straight on.
    """
    unit, count = network.unit_length, positions.shape[1]
    passed = passages(positions, network)
    errors = np.stack(
        [errors_in_use(positions[:, k], passed[k], network) for k in range(count)], axis=1
    )
    pieces = _nearest_pieces(positions[-1], network)
    kinds = [network.kind(piece) for piece in pieces]
    resting = spans_less(times, positions, REST_WINDOW * unit, REST_SPAN * unit)
    to_end = np.full(count, np.inf)
    if len(ends):
        to_end = np.linalg.norm(positions[-1][:, None] - ends, axis=2).min(axis=1)
    at_end = resting & (to_end <= END_DISTANCE * unit)
    reach = np.argmax(errors <= REACH_DISTANCE * unit, axis=0)
    reached = np.asarray((errors <= REACH_DISTANCE * unit).any(axis=0))
    first, last = np.zeros(count, int), np.full(count, len(times))
    lapped, ended, counts = np.zeros((3, count), bool)
    for k in range(count):
        numbers = _one_way_numbers(network, pieces[k])
        if kinds[k] == "closed path":
            window = _last_lap(passed[k], numbers)
            if window is not None:
                first[k], last[k] = window[0], window[1] + 1
                lapped[k] = (errors[slice(*window), k] <= SETTLE_DISTANCE * unit).all()
            counts[k] = lapped[k]
        elif kinds[k] == "open path":
            ended[k] = at_end[k] and _in_order([p.edge for p in passed[k]], numbers)
            first[k] = reach[k]
            last[k] = max(_arrival(positions[:, k], ends, unit), reach[k]) + 1
            counts[k] = ended[k]
        else:
            first[k] = np.searchsorted(times, times[reach[k]] + WAY_OFF * unit)
            counts[k] = reached[k] and first[k] < last[k]
    own = [
        errors[first[k] : last[k], k] if counts[k] else np.full(1, np.nan) for k in range(count)
    ]
    lower, upper = box
    outside = np.abs(positions - (lower + upper) / 2) > LEAVE_BOXES * (upper - lower) / 2
    still = spans_less(times, positions, STALL_WINDOW * unit, STALL_SPAN * unit)
    return NetworkMetrics(
        reached=reached,
        lapped=lapped,
        ended=ended,
        stalled=still & ~at_end,
        left=np.asarray(outside.any(axis=(0, 2))),
        kind=kinds,
        rms=np.array([np.sqrt((values**2).mean()) for values in own]),
        maximum=np.array([values.max() for values in own]),
        first=first,
        until=last - 1,
        errors=errors,
        straight_fraction=straight_fraction(passed, network),
        turn_fraction=None if route is None else turn_fraction(passed, route),
    )


def _nearest_pieces(positions: FloatArray, network: PathNetwork) -> IntArray:
    """The piece that each position (n, d) is nearest to."""
    route = network.path.project(positions).piece
    return np.array([network.routes[k].piece for k in route])


def _one_way_numbers(network: PathNetwork, piece: int) -> list[int]:
    """The edges of a piece that is one path, in order."""
    route = next(route for route in network.routes if route.piece == piece)
    return [edge + 1 for edge in route.edges]


def _last_lap(passed: list[Passage], numbers: list[int]) -> tuple[int, int] | None:
    """The samples of the last whole lap of a closed path, whichever edge it begins with."""
    edges = [p.edge for p in passed]
    count = len(numbers)
    for end in range(len(edges) - 1, count - 1, -1):
        lap = edges[end - count : end + 1]
        if lap[0] in numbers:
            at = numbers.index(lap[0])
            if lap == numbers[at:] + numbers[: at + 1]:
                return passed[end - count].sample, passed[end].sample
    return None


def _in_order(edges: list[int], numbers: list[int]) -> bool:
    """Whether the edges run along are the last ones of an open path, in order."""
    return not edges or edges == numbers[len(numbers) - len(edges) :]


def _arrival(positions: FloatArray, ends: FloatArray, unit: float) -> int:
    """The sample since which an agent has been at an end."""
    from_end = np.linalg.norm(positions[:, None] - ends, axis=2).min(axis=1)
    return int(since_last(from_end[:, None] > END_DISTANCE * unit)[0])
