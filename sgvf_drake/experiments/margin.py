"""The velocity error of a flight against the margin that a certificate proves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.arrays import BoolArray
from sgvf_drake.experiments.certified import CertifiedField
from sgvf_drake.experiments.fly import TAKE_OFF_S, PieceFlight

NOT_COVERED = (
    "the take-off and the way to the tube: a vehicle that stands is in error by all of its "
    "speed; they are told apart",
    "levels below c_in, of which nothing is proved: inside the tube the error is held against "
    "the margin of the tube's border, c_in",
    "levels above c_out",
    "what happens between the logged times",
    "altitude and attitude: the certificate speaks of the position in the plane",
    "any other flight: the error is measured, of one simulated vehicle, and not bounded",
)


@dataclass(frozen=True, eq=False)
class FlightMargin:
    """The velocity error of one flight, and what the levels that it crosses tolerate.

    The certificate says that {V <= c} stays invariant under p_dot = speed m(p) + d while
    |d| < speed e*(c) on its border.  So d = v_WB - speed m(p) is the error of the vehicle's
    true velocity, in the plane, from the certified field at the commanded speed.  Where the
    vehicle flies a wider field (`systems.FieldForSpeed`), the difference is a part of d.

    Attributes:
        piece: Number of the piece in the reference.
        speed: Commanded, m/s.
        table: One row a sample: time (s), x and y in the unit of the waypoints, V, error
            |d| / speed, e_star (zero above c_out), and ratio, the error over e_star.
        settled: Which samples, (T,), are those from the first one in the tube on, after the
            take-off.
        certified: What is proved.
    """

    piece: int
    speed: float
    table: pd.DataFrame
    settled: BoolArray
    certified: CertifiedField

    @property
    def inside(self) -> bool:
        """Whether the flight settled, and was inside the margin at every sample since then."""
        ratio = self.table["ratio"][self.settled]
        return bool(len(ratio) and (ratio < 1).all())

    def summary(self) -> dict[str, Any]:
        """Returns the figures by plain names; None where the flight never settled.

        Errors are parts of the speed.  `covering_level` is the lowest level c that tolerates
        the largest error since the flight settled: that {V <= c} is not left under such errors
        is proved.  None: there is no such level.  `inside_from_s` is the time from which on no
        error was outside of the margin; None: the last one was.
        """
        found, settled = self.certified.certificate, self.table[self.settled]
        assert found.conditions is not None
        figures: dict[str, Any] = {
            "piece": self.piece,
            "inside_margin": self.inside,
            "settled_s": None,
            "error_median": None,
            "error_99_percent": None,
            "error_max": None,
            "worst_ratio": None,
            "time_outside_s": None,
            "covering_level": None,
            "V_max_settled": None,
            "stayed_in_tube": None,
            "stayed_in_certified_set": bool((self.table["V"] <= found.conditions.c_out).all()),
            "inside_from_s": self._inside_from(),
            "way_in": self._way_in(),
        }
        if settled.empty:
            return figures
        largest, highest = float(settled["error"].max()), float(settled["V"].max())
        # Each margin holds on a closed interval of levels, so at its lower end.
        levels = np.array(found.levels[:-1])
        covering = levels[(np.array(found.e_star) > largest) & (levels >= highest)]
        return figures | {
            "settled_s": float(settled["time"].iloc[0]),
            "error_median": float(settled["error"].median()),
            "error_99_percent": float(settled["error"].quantile(0.99)),
            "error_max": largest,
            "worst_ratio": float(settled["ratio"].max()),
            "time_outside_s": self._time_outside(settled),
            "covering_level": float(covering[0]) if len(covering) else None,
            "V_max_settled": highest,
            "stayed_in_tube": highest <= found.conditions.c_in,
        }

    def _way_in(self) -> dict[str, Any] | None:
        """Returns the figures from the take-off to the tube; None: there is no such sample."""
        way = self.table[~self.settled & (self.table["time"] >= TAKE_OFF_S)]
        if way.empty:
            return None
        return {
            "begin_s": float(way["time"].iloc[0]),
            "end_s": float(way["time"].iloc[-1]),
            "error_max": float(way["error"].max()),
            "worst_ratio": float(way["ratio"].max()),
            "time_outside_s": self._time_outside(way),
        }

    def _inside_from(self) -> float | None:
        outside = np.flatnonzero(self.table["ratio"] >= 1)
        first = outside[-1] + 1 if len(outside) else 0
        return float(self.table["time"].iloc[first]) if first < len(self.table) else None

    def _time_outside(self, samples: pd.DataFrame) -> float:
        period = float(np.diff(self.table["time"][:2])[0])
        return float((samples["ratio"] >= 1).sum() * period)


def flight_margin(certified: CertifiedField, flight: PieceFlight, speed: float) -> FlightMargin:
    """Returns the velocity error of a flight against a certificate; see `FlightMargin`.

    Args:
        certified: The field, and what is proved of it.
        flight: Along one piece; from `fly` with the field in metres.
        speed: Commanded, m/s.
    """
    log = flight.log
    x = log[["x", "y"]].to_numpy() / certified.scale
    V = certified.V(x)
    d = log[["vx", "vy"]].to_numpy() / speed - certified.field(x)
    error, e_star = np.linalg.norm(d, axis=1), certified.e_star(V)
    with np.errstate(divide="ignore"):
        ratio = error / e_star
    table = pd.DataFrame({"time": log["time"], "x": x[:, 0], "y": x[:, 1], "V": V})
    table = table.assign(error=error, e_star=e_star, ratio=ratio)
    c_in = certified.certificate.levels[0]
    in_tube = (c_in >= V) & (table["time"].to_numpy() >= TAKE_OFF_S)
    return FlightMargin(
        flight.piece, speed, table, np.logical_or.accumulate(in_tube), certified
    )


def margin_summary(flights: Sequence[FlightMargin]) -> dict[str, Any]:
    """Returns the worst of the flights, each of them, and what none of them covers.

    Args:
        flights: One a piece; at least one, all against the same certificate.
    """
    found = flights[0].certified.certificate
    assert found.conditions is not None
    pieces = [flight.summary() for flight in flights]

    def worst(name: str) -> float | None:
        values = [piece[name] for piece in pieces]
        return None if None in values else max(values)

    return {
        "inside_margin": all(piece["inside_margin"] for piece in pieces),
        "error_max": worst("error_max"),
        "worst_ratio": worst("worst_ratio"),
        "time_outside_s": worst("time_outside_s"),
        "covering_level": worst("covering_level"),
        "stayed_in_tube": all(piece["stayed_in_tube"] for piece in pieces),
        "stayed_in_certified_set": all(piece["stayed_in_certified_set"] for piece in pieces),
        "certified": found.certified,
        "field_digest": found.field_digest,
        "c_in": found.conditions.c_in,
        "c_out": found.conditions.c_out,
        "e_star_tube": found.e_star[0],
        "e_star_max": found.e_star_max,
        "what_it_does_not_cover": list(NOT_COVERED),
        "pieces": pieces,
    }
