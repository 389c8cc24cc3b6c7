"""From a directed field to the certificate of its network."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.certification import ONE_THREAD
from sgvf_drake.certificate.kernels import SLACK, check_rounding
from sgvf_drake.certificate.leg_search import OPEN, Obstacle
from sgvf_drake.certificate.legs import Leg, ProvedLeg, are_chained, prove_leg
from sgvf_drake.certificate.network import (
    EdgeDisks,
    NetworkCertificate,
    Place,
    Stretch,
    automaton_of,
)
from sgvf_drake.certificate.network_search import NetworkSearch
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import DirectedField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.paths.automaton import Automaton
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.progress import Progress, no_progress

ProposeLegs = Callable[[Place], list[ProvedLeg] | Obstacle]
"""From a section, a turn or the way to an end to legs, proved or not, or why there are none."""

# Points between two sections at which the distance of a tube from the path is measured.
PARTS = 4


def certify_network(
    field: DirectedField,
    route: Itinerary | None = None,
    *,
    progress: Progress = no_progress,
) -> NetworkCertificate:
    """Proves of every section and every turn of a network that robots follow it.

    Args:
        field: The field.
        route: A route that is asked for; None: the whole network is.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is of a kind that nothing bounds, or the route of another
            network.
        RuntimeError: The process does not round to nearest.
    """
    check_rounding()
    numbers, closed = (None, False) if route is None else (route.edges, route.closed)
    search = NetworkSearch(field)
    with threadpool_limits(**ONE_THREAD):
        return _certificate(field, search.disks, search.find, numbers, closed, progress)


def check_network(
    certificate: NetworkCertificate, field: DirectedField, progress: Progress = no_progress
) -> NetworkCertificate:
    """Proves a certificate anew from what it holds, without a search.

    Returns:
        What was proved; it is certified where it is as strong as what was claimed.

    Raises:
        ConfigurationError: The certificate is that of another field, or of another network, or
            of a route that its network does not have.
        RuntimeError: The process does not round to nearest.
    """
    if certificate.field_digest != field_digest(field):
        raise ConfigurationError("the certificate is that of another field")
    check_rounding()
    claimed = {stretch.place: stretch for stretch in certificate.stretches}

    def known(place: Place) -> list[ProvedLeg] | Obstacle:
        claim = claimed.get(place, Stretch(place, reason="nothing is claimed of it"))
        if not claim.legs or any(len(leg.direction) != field.dim for leg in claim.legs):
            return Obstacle(claim.reason or OPEN, claim.where or ())
        return [prove_leg(field, leg) for leg in claim.legs]

    with threadpool_limits(**ONE_THREAD):
        found = _certificate(
            *(field, certificate.disks, known),
            *(certificate.route, certificate.route_closed, progress),
        )
    if not found.is_as_strong_as(certificate):
        return found.refused("what is claimed is not what is proved")
    return found


def _places(field: DirectedField, automaton: Automaton) -> list[Place]:
    """Returns all sections, all turns, and the ways to all ends at which robots rest."""
    sections = [
        Place(number, number, index)
        for number, cut in automaton.edges.items()
        for index in range(len(cut.directions))
    ]
    turns = [Place(before, after) for before, after in automaton.turns]
    ends = [
        Place(number, None)
        for number, cut in automaton.edges.items()
        if len(field.ends) and _leads_to(cut.line[-1], field)
    ]
    return [*sections, *turns, *ends]


def _leads_to(point: FloatArray, field: DirectedField) -> bool:
    """Whether a point is one where robots come to rest, within a noise level."""
    distance = np.linalg.norm(field.ends - point, axis=1)
    return bool(distance.min() < field.memory_length)


def _certificate(
    field: DirectedField,
    disks: tuple[EdgeDisks, ...],
    propose: ProposeLegs,
    route: Sequence[int] | None,
    closed: bool,
    progress: Progress,
) -> NetworkCertificate:
    """Returns what legs prove of a network, and of a route."""
    automaton, boxes = automaton_of(field, disks), 0
    if route is not None:
        Itinerary.along(route, field.network, closed=closed)
    places, stretches = _places(field, automaton), []
    for done, place in enumerate(places):
        progress("sections and turns", done, len(places))
        found = propose(place)
        boxes += 0 if isinstance(found, Obstacle) else sum(one.proof.patches for one in found)
        line = automaton.line_of(place.before, place.after, place.index)
        stretches.append(_stretch(field, place, disks, found, line))
    progress("sections and turns", len(places), len(places))
    result = NetworkCertificate(
        certified=False,
        reason="",
        field_digest=field_digest(field),
        disks=disks,
        stretches=tuple(stretches),
        boxes=boxes,
    )
    return _asked(result, route, closed)


def _stretch(
    field: DirectedField,
    place: Place,
    disks: Sequence[EdgeDisks],
    found: list[ProvedLeg] | Obstacle,
    line: FloatArray,
) -> Stretch:
    """Returns what legs prove of a section, a turn, or the way to an end.

    Args:
        field: The field.
        place: Which it is.
        disks: Those of all edges.
        found: The legs, or why there are none.
        line: (M, d) what is travelled of the path.
    """
    if isinstance(found, Obstacle):
        return Stretch(place, reason=found.reason, where=found.place)
    start, end = place.between(disks)
    legs = tuple(one.leg for one in found)
    if not all(one.proof.proved for one in found):
        return Stretch(place, reason=OPEN)
    if start is None or (end is None) != place.rests or not are_chained(legs, start, end):
        return Stretch(place, reason="its legs are not chained from disk to disk")
    unit, slack = field.cloud.unit_length, SLACK * len(found)
    half_width = unit * max(leg.tube.half_width for leg in legs)
    return Stretch(
        place,
        legs,
        time_low=unit * (1 - slack) * sum(one.proof.time_low for one in found),
        time_high=unit * (1 + slack) * sum(one.proof.time_high for one in found),
        half_width=half_width,
        off=half_width + _apart(_middles(field, legs), line),
    )


def _middles(field: DirectedField, legs: Sequence[Leg]) -> FloatArray:
    """Returns the line (M, d) along the middles of legs, in the unit of the waypoints."""
    return field.cloud.denormalize(np.concatenate([leg.tube.rows[:, 0] for leg in legs]))


def _apart(one: FloatArray, other: FloatArray) -> float:
    """Returns the largest distance of a point of one of two lines from the other, at most."""
    largest, lines = 0.0, [Piece(line, closed=False) for line in (one, other)]
    for line, beside in (lines, lines[::-1]):
        count = PARTS * len(line.vertices)
        points = line.at(np.linspace(0, line.length, count + 1))
        off = ReferencePath((beside,)).project(points).distance.max()
        largest = max(largest, off + line.length / (2 * count))
    return float((1 + SLACK) * largest)


def _asked(
    result: NetworkCertificate, route: Sequence[int] | None, closed: bool
) -> NetworkCertificate:
    """Returns the certificate of a network with what it says of what was asked for."""
    if route is None:
        missing = [own for own in (*result.sections, *result.turns) if not own.proved]
        parts = (("sections", result.sections), ("turns", result.turns))
        counts = (f"{sum(own.proved for own in of)} of {len(of)} {name}" for name, of in parts)
        return replace(
            result, certified=not missing, reason=f"{' and '.join(counts)} are proved"
        )
    along = result.along(route, closed=closed)
    missing = [own for own in along if not own.proved]
    result = replace(result, route=tuple(route), route_closed=closed)
    if missing:
        names = ", ".join(str(own.place) for own in missing)
        return replace(result, reason=f"of the route this is not proved: {names}")
    low, high = (
        (1 + sign * SLACK * len(along)) * sum(getattr(own, name) for own in along)
        for sign, name in ((-1, "time_low"), (1, "time_high"))
    )
    return replace(
        result,
        certified=True,
        reason="robots that enter the first disk of the route follow it",
        route_time_low=low,
        route_time_high=high,
    )
