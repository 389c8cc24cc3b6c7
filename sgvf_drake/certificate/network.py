"""The certificate of a network: which of its sections and turns are proved, and its file."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from sgvf_drake.certificate.document import Document, bounds_hold
from sgvf_drake.certificate.legs import Disk, Leg
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import DirectedField
from sgvf_drake.paths.automaton import Automaton


@dataclass(frozen=True)
class EdgeDisks:
    """The disks at the guards of an edge, in a direction of travel.

    Attributes:
        number: The edge, from 1; negative if it is travelled from its end to its start.
        guards: Which of the guards of its cut they are at, from 0, from the first to the last.
        disks: The disks in the order of travel; None where no robot was found to come.
    """

    number: int
    guards: tuple[int, ...]
    disks: tuple[Disk | None, ...]

    def are_at(self, count: int, dim: int) -> bool:
        """Whether they are at guards from the first to the last of so many, in so many axes."""
        ends = (self.guards[:1], self.guards[-1:])
        return (
            len(self.guards) == len(self.disks)
            and ends == ((0,), (count - 1,))
            and all(one < other for one, other in pairwise(self.guards))
            and all(disk is None or len(disk) == dim for disk in self.disks)
        )

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "EdgeDisks":
        """Returns those of a JSON object."""
        disks = tuple(None if disk is None else _disk(disk) for disk in body["disks"])
        guards = tuple(map(_whole, body["guards"]))
        return cls(_whole(body["number"]), guards, disks)


def automaton_of(field: DirectedField, disks: Iterable[EdgeDisks]) -> Automaton:
    """Returns the automaton of a field that has its guards at disks.

    Raises:
        ConfigurationError: The disks are not at guards of every edge of its network, from the
            first to the last, or not of its space.
    """
    automaton = Automaton.of(field.network, field.memory_length)
    of = {own.number: own for own in disks}
    if of.keys() != automaton.edges.keys() or not all(
        own.are_at(len(automaton.edges[number].guards), field.dim) for number, own in of.items()
    ):
        raise ConfigurationError("the certificate has not the disks of this network")
    return automaton.keeping({number: own.guards for number, own in of.items()})


def _disk(body: Sequence[Sequence[object]]) -> Disk:
    disk = tuple(tuple(map(_whole, row)) for row in body)
    if len(disk) not in (2, 3) or any(len(row) != len(disk) for row in disk):
        raise ValueError("a disk is two rows of two numbers, or three of three")
    return disk


def _whole(value: object) -> int:
    if type(value) is not int:
        raise TypeError(f"{value!r} is not a whole number")
    return value


@dataclass(frozen=True)
class Place:
    """A section of an edge, a turn from one edge into another, or the way to an end.

    Attributes:
        before: The number of the edge that it begins on.
        after: That of the edge which it leads into; None: it leads to rest.
        index: The place of a section on the edge, from 0; None: it begins at the last disk.
    """

    before: int
    after: int | None
    index: int | None = None

    @property
    def rests(self) -> bool:
        """Whether it leads to rest."""
        return self.after is None

    @property
    def turns(self) -> bool:
        """Whether it leads from one edge into another."""
        return self.after is not None and self.index is None

    def between(self, disks: Iterable[EdgeDisks]) -> tuple[Disk | None, Disk | None]:
        """Returns the disks at its beginning and at its end, if they are known."""
        of = {own.number: own.disks for own in disks}
        if self.index is not None:
            first, last = of[self.before][self.index : self.index + 2]
            return first, last
        return of[self.before][-1], None if self.after is None else of[self.after][0]

    def __str__(self) -> str:
        if self.index is not None:
            return f"section {self.index + 1} of edge {self.before}"
        if self.after is None:
            return f"rest at the end of edge {self.before}"
        return f"turn from edge {self.before} into {self.after}"


@dataclass(frozen=True)
class Stretch:
    """What is proved of a section, a turn, or the way to an end.

    Times are those at |m| = 1: at speed v, they are divided by v.  Lengths and times are in the
    unit of the waypoints.

    Attributes:
        place: Which it is.
        legs: Tubes that lead from its first disk into its last; none: it is not proved.
        time_low: The time that they take, at least; None, as the following: it is not proved.
        time_high: The same, at most.
        half_width: Largest distance of the tubes from the line along their middles.
        off: Largest distance between them and the path, either way, at most.
        reason: Why it is not proved; None: it is.
        where: (d,) where a robot ended that did not come to the last disk, or else the place
            of the first one; None: it is proved.
    """

    place: Place
    legs: tuple[Leg, ...] = ()
    time_low: float | None = None
    time_high: float | None = None
    half_width: float | None = None
    off: float | None = None
    reason: str | None = None
    where: tuple[float, ...] | None = None

    @property
    def proved(self) -> bool:
        """Whether what enters its first disk leaves through its last, or comes to rest."""
        return bool(self.legs)

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Stretch":
        """Returns the stretch of a JSON object."""
        where = body["where"]
        return cls(
            **{
                **body,
                "place": Place(**body["place"]),
                "legs": tuple(map(Leg.of, body["legs"])),
                "where": None if where is None else tuple(where),
            }
        )


# What a claim may be weaker in than what is proved.
AT_LEAST, AT_MOST = ("time_low",), ("time_high", "half_width", "off")


@dataclass(frozen=True)
class NetworkCertificate(Document):
    """A proof that robots follow the edges of a network and make its turns.

    What is proved is said of the automaton that holds one intended direction g in each section,
    and changes it at once where the section ends: **what enters the first disk of an edge, or
    of a turn, leaves through its last disk**, in a time between bounds and inside of the tubes.
    Every stretch ends where others begin, so that all routes over proved stretches are proved.

    It is not proved of a robot whose heading turns gradually to a new g, as in flight, nor how
    robots come to a first disk.

    Attributes:
        certified: Whether all that was asked for is proved: every section and turn of a route,
            or of the whole network.
        reason: Why it is so or not, in words.
        field_digest: That of the field.
        disks: Those of every edge that can be travelled, in each direction.
        stretches: The sections, the turns, and the ways to ends.
        route: The edges of a route; None: none was asked for.
        route_closed: Whether it repeats.
        route_time_low: The time from the first disk of the route to its last, or of a lap, at
            least; None: no route was asked for, or it is not proved.
        route_time_high: The same, at most.
        boxes: Number of patches over which the field was bounded.
    """

    certified: bool
    reason: str
    field_digest: str
    disks: tuple[EdgeDisks, ...] = ()
    stretches: tuple[Stretch, ...] = ()
    route: tuple[int, ...] | None = None
    route_closed: bool = False
    route_time_low: float | None = None
    route_time_high: float | None = None
    boxes: int = 0

    FORMAT, VERSION = "sgvf_drake.network_certificate", 1

    @property
    def sections(self) -> list[Stretch]:
        """What is proved of the sections of all edges."""
        return [stretch for stretch in self.stretches if stretch.place.index is not None]

    @property
    def turns(self) -> list[Stretch]:
        """What is proved of the turns."""
        return [stretch for stretch in self.stretches if stretch.place.turns]

    @property
    def ends(self) -> list[Stretch]:
        """What is proved of the ways to ends."""
        return [stretch for stretch in self.stretches if stretch.place.rests]

    def along(self, route: Sequence[int], *, closed: bool) -> list[Stretch]:
        """Returns the stretches of a route, in the order of travel.

        Args:
            route: The numbers of its edges.
            closed: Whether the last leads into the first.
        """
        return [self._of_place[place] for place in self._places(route, closed)]

    @property
    def _of_place(self) -> dict[Place, Stretch]:
        return {stretch.place: stretch for stretch in self.stretches}

    def _places(self, route: Sequence[int], closed: bool) -> Iterator[Place]:
        counts = {own.number: len(own.disks) - 1 for own in self.disks}
        for number, after in pairwise([*route, *(route[:1] if closed else [None])]):
            yield from (Place(number, number, index) for index in range(counts[number]))
            if after is not None:
                yield Place(number, after)

    def is_as_strong_as(self, other: "NetworkCertificate", tolerance: float = 1e-9) -> bool:
        """Whether this one proves what another claims, but for rounding.

        On other machines the last bits of bounds differ.
        """
        mine, claimed = (
            (one.certified, one.disks, one.route, one.route_closed) for one in (self, other)
        )
        own = self._of_place
        return (
            mine == claimed
            and own.keys() == other._of_place.keys()
            and bounds_hold(self, other, ("route_time_low",), ("route_time_high",), tolerance)
            and all(
                own[claim.place].legs == claim.legs
                and bounds_hold(own[claim.place], claim, AT_LEAST, AT_MOST, tolerance)
                for claim in other.stretches
            )
        )

    @classmethod
    def _of(cls, body: Mapping[str, Any]) -> "NetworkCertificate":
        route = body["route"]
        return cls(
            **{
                **body,
                "disks": tuple(map(EdgeDisks.of, body["disks"])),
                "stretches": tuple(map(Stretch.of, body["stretches"])),
                "route": None if route is None else tuple(map(_whole, route)),
            }
        )

    def refused(self, reason: str) -> "NetworkCertificate":
        """Returns the same as not certified, with a reason before its own."""
        return replace(self, certified=False, reason=f"{reason}; {self.reason}")
