"""Certify the network of a directed field: the proof, its file, its figure, and the check."""

from os import PathLike
from typing import Any

from sgvf_drake.certificate import NetworkCertificate, certify_network, check_network
from sgvf_drake.certificate.network import Stretch
from sgvf_drake.experiments.certify import leave_proof
from sgvf_drake.experiments.figures.network_certificate import network_certificate_figure
from sgvf_drake.fields import DirectedField
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.progress import Progress, no_progress


def run_certify_network(
    field: DirectedField,
    route: Itinerary | None,
    out: str | PathLike[str],
    *,
    claimed: NetworkCertificate | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Certifies the network of a directed field, or a route on it.

    Leaves the certificate, its figure and the summary.  A `claimed` certificate of the field is
    proved anew; without one, one is searched for.  The time that it takes is told without that
    of compiling.

    Raises:
        ConfigurationError: Nothing bounds the field, or what is claimed is claimed of another
            field.
    """

    def prove() -> NetworkCertificate:
        if claimed is not None:
            return check_network(claimed, field, progress)
        return certify_network(field, route, progress=progress)

    return leave_proof(
        *(field, out, prove, network_certificate_figure, network_summary),
        checked=claimed is not None,
        overwrite=overwrite,
    )


def network_summary(found: NetworkCertificate) -> dict[str, Any]:
    """Returns what was proved, by the names of `summary.json`."""
    route = None
    if found.route is not None:
        route = {
            "edges": list(found.route),
            "closed": found.route_closed,
            "time_low": found.route_time_low,
            "time_high": found.route_time_high,
        }
    return {
        "certified": found.certified,
        "reason": found.reason,
        "method": "proved",
        "sections": [_told(own) for own in found.sections],
        "turns": [_told(own) for own in found.turns],
        "ends": [_told(own) for own in found.ends],
        "route": route,
        "boxes": found.boxes,
    }


def _told(own: Stretch) -> dict[str, Any]:
    """Returns what is told of a section, a turn or the way to an end."""
    place = own.place
    if place.index is not None:
        where: dict[str, Any] = {"edge": place.before, "section": place.index}
    elif place.rests:
        where = {"edge": place.before}
    else:
        where = {"from": place.before, "into": place.after}
    return {
        **where,
        "proved": own.proved,
        **{name: getattr(own, name) for name in ("time_low", "time_high", "half_width", "off")},
        "reason": own.reason,
        "where": own.where,
    }
