"""Routes on the network of a directed field, as the template of their C code takes them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sgvf_drake.export.c_numbers import CArray, literal
from sgvf_drake.fields import DirectedField
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import FIRST, TIE, Navigator
from sgvf_drake.paths.planning import covering

ARRAYS = ("samples", "guards", "directions", "floors", "ceilings")
LENGTHS = ("spacing", "behind", "ahead", "lost")

CONSTANTS = {"first": literal(FIRST), "tie": literal(TIE)}
"""Those of all routes."""


def navigators_of(
    field: DirectedField, routes: Sequence[Itinerary | str] | None
) -> list[Navigator]:
    """Returns the automata of routes, by default of one over each piece.

    Raises:
        ConfigurationError: If an edge does not exist, or does not follow the one before it.
    """
    network = field.network
    if routes is None:
        routes = [covering(network, piece) for piece in range(network.num_pieces)]
    itineraries = [
        Itinerary.parse(route, network) if isinstance(route, str) else route for route in routes
    ]
    return [Navigator(itinerary, field.memory_length) for itinerary in itineraries]


def route_code(number: int, navigator: Navigator) -> tuple[dict[str, Any], list[CArray]]:
    """Returns what the template says of a route, and its arrays."""
    tables, itinerary = navigator.tables, navigator.itinerary
    arrays = [
        CArray(f"route_{number}_{name}", "double", np.asarray(getattr(tables, name)))
        for name in ARRAYS
    ]
    constants = {
        "edges": ",".join(map(str, itinerary.edges)),
        "closed": itinerary.closed,
        "length": literal(itinerary.length),
        "num_sections": len(navigator.sections),
        "num_samples": len(tables.samples),
        "num_looked_at": tables.num_looked_at,
        **{name: literal(getattr(tables, name)) for name in LENGTHS},
    }
    return constants, arrays
