"""The velocity error of flights, against what the level sets of V tolerate.

With the error d = v_WB - speed m(p), V_dot = speed grad V . m + grad V . d, which is negative
on a level set {V = c} while |d| < speed e*(c), where e*(c) is the smallest inward normal speed
of m there; then {V <= c} is invariant.  Here e* is what `verify` has sampled (`TrackingResult`)
or what a certificate proves (`FlightMargin`); the errors are measured, not bounded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import pandas as pd

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.certified import CertifiedField
from sgvf_drake.experiments.flight import (
    TAKE_OFF_S,
    FlightSpec,
    flown_pieces,
    positions_of,
    simulate,
    velocities_of,
)
from sgvf_drake.experiments.fly import PieceFlight
from sgvf_drake.fields import Field, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction, Margins
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import SublevelExit

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
class VelocityErrors:
    """The velocity errors of one flight over V.

    Attributes:
        piece: Number of the piece in the reference.
        log: As that of the flight, and for each sample V and error, the |v_WB - speed m(p_WB)|
            over the dimensions of the field, as a part of the speed.
        settled: Which samples, (T,), are those from the first one in the tube on.
        exit: Where and when the vehicle left the set that it was to stay in, which ended the
            flight; None: it did not, or there was none.
    """

    piece: int
    log: pd.DataFrame
    settled: BoolArray
    exit: SublevelExit | None = None

    def settled_figures(self) -> dict[str, float | None]:
        """Returns what was measured since the flight settled; None where it never did."""
        settled = self.log[self.settled]
        figures = {
            "settled_s": settled["time"].min(),
            "error_median": settled["error"].median(),
            "error_99_percent": settled["error"].quantile(0.99),
            "error_max": settled["error"].max(),
            "V_max_settled": settled["V"].max(),
        }
        return {name: None if settled.empty else float(x) for name, x in figures.items()}

    def lowest_covering(self, levels: ArrayLike, e_star: ArrayLike) -> float | None:
        """Returns the first of rising levels that tolerates the largest settled error.

        None: none does, or the flight never settled.
        """
        largest = self.settled_figures()["error_max"]
        if largest is None:
            return None
        covering = np.asarray(levels)[np.asarray(e_star) > largest]
        return float(covering[0]) if len(covering) else None


def velocity_error(
    log: pd.DataFrame, field: Field, speed: float, scale: float = 1.0
) -> FloatArray:
    """Returns |v_WB - speed m(p_WB)| over the dimensions of a field, (T,) as a part of speed.

    Args:
        log: The log of a flight, in metres; of a live one the speed is that of each sample.
        field: m, in a unit of `scale` metres.
        speed: Commanded speed, m/s.
        scale: Metres in one unit of the field.
    """
    m = field(positions_of(log, field.dim) / scale)
    speeds = log["live_speed"].to_numpy()[:, None] if "live_speed" in log else speed
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = velocities_of(log, field.dim) / speeds - m
    return np.asarray(np.linalg.norm(errors, axis=1))


def worst_of(pieces: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """Returns the largest figure of a name; None where a piece has none."""
    values = [piece[name] for piece in pieces]
    return None if None in values else max(values)


# Against e* that was sampled.


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """The velocity errors of the flights along all pieces.

    Attributes:
        flights: One a piece.
        speed: Commanded speed, m/s.
        c_in: A flight has settled once it is inside {V <= c_in}.
        level: The flights are to stay in {V <= level}.
        margins: What the level sets tolerate, at unit speed.
    """

    flights: Sequence[VelocityErrors]
    speed: float
    c_in: float
    level: float
    margins: Margins

    @property
    def tolerated(self) -> float:
        """The velocity error that the level tolerates, m/s."""
        return self.speed * self.margins.at(self.level)

    def summary(self) -> dict[str, Any]:
        """Returns the worst of the pieces, and each of them under `pieces`.

        `covered` tells whether the largest settled error of every flight stays below the
        tolerated one of the level that it is to stay in, and `smallest_covering_level` the
        smallest level of the margins that tolerates it; None: none does.
        """
        pieces = [self._summary_of(flight) for flight in self.flights]
        return {
            "speed_command_m_s": self.speed,
            "c_in": self.c_in,
            "level": self.level,
            "tolerated_error_m_s": self.tolerated,
            "tracking_error_max_m_s": worst_of(pieces, "tracking_error_max_m_s"),
            "covered": all(piece["covered"] for piece in pieces),
            "stayed": all(flight.exit is None for flight in self.flights),
            "pieces": pieces,
        }

    def _summary_of(self, flight: VelocityErrors) -> dict[str, Any]:
        figures = flight.settled_figures()
        median, high, largest = (
            value and self.speed * value
            for value in (figures[f"error_{name}"] for name in ("median", "99_percent", "max"))
        )
        return {
            "piece": flight.piece,
            "settled_s": figures["settled_s"],
            "tracking_error_50_percent_m_s": median,
            "tracking_error_99_percent_m_s": high,
            "tracking_error_max_m_s": largest,
            "covered": None if largest is None else largest < self.tolerated,
            "smallest_covering_level": flight.lowest_covering(
                self.margins.levels, self.margins.e_star
            ),
            "V_max_settled": figures["V_max_settled"],
            "exit": None if flight.exit is None else str(flight.exit),
        }


def flight_tracking(
    field: GuidingField,
    reference: ReferencePath,
    speed: float,
    function: LyapunovFunction,
    margins: Margins,
    *,
    c_in: float,
    level: float,
    progress: Progress = no_progress,
    **options: Any,
) -> TrackingResult:
    """Flies along every piece, and compares the velocity error with what V tolerates.

    The field m is the one that is flown, `systems.FieldForSpeed`, and so must be that of e*.

    What this does not cover: the take-off, in which the vehicle stands still and the error
    is the speed itself, so that the comparison begins where the flight is first inside
    {V <= c_in}; the vertical motion over a planar field; and what lies between the samples,
    of the flight and of e*.  It is a comparison of measured figures, not a proof.

    Args:
        field: The field, in metres; planar or spatial.
        reference: Holds the pieces that are flown, in metres.
        speed: Commanded speed, m/s.
        function: V, of the field's dimension, in metres.
        margins: e* of the flown field on levels of V.
        c_in: A flight has settled once it is inside {V <= c_in}.
        level: A flight is to stay in {V <= level} once it is inside, and ends if it does
            not; at least c_in, and one of the margins' range.
        progress: Is told how far each simulation is.
        **options: The rest of the `FlightSpec`.

    Raises:
        ConfigurationError: If a value cannot be used, or if the vehicle lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    spec = FlightSpec(speed, **options)
    lowest, highest = margins.levels[0], margins.levels[-1]
    if not max(c_in, lowest) <= level <= highest:
        raise ConfigurationError(
            f"the level must be at least c_in = {c_in:g}, and one of those whose margin is "
            f"known, {lowest:g} to {highest:g}, not {level:g}"
        )
    flights = []
    for piece in flown_pieces(field, reference):
        flown = simulate(
            field, reference, spec, piece, lyapunov=function, level=level, progress=progress
        )
        error = velocity_error(flown.log, spec.craft.FlownField(field, speed), speed)
        settled = np.logical_or.accumulate(flown.log["V"].to_numpy() <= c_in)
        flights.append(
            VelocityErrors(piece, flown.log.assign(error=error), settled, flown.exit)
        )
    return TrackingResult(flights, speed, c_in, level, margins)


# Against e* that is proved.


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightMargin(VelocityErrors):
    """The velocity error of one flight against the margin that a certificate proves.

    The error is that from the certified field.  Where the vehicle flies a wider one
    (`systems.FieldForSpeed`), the difference is a part of the error.

    Attributes:
        certified: What is proved.  The log has two columns more: e_star, what the level of
            each sample tolerates (zero above c_out), and ratio, the error over it.  The
            take-off does not count as settled.
    """

    certified: CertifiedField

    @property
    def positions(self) -> FloatArray:
        """Where the vehicle was, (T, 2) in the unit of the waypoints."""
        return positions_of(self.log, 2) / self.certified.scale

    @property
    def inside(self) -> bool:
        """Whether the flight settled, and was inside the margin at every sample since then."""
        ratio = self.log["ratio"][self.settled]
        return bool(len(ratio) and (ratio < 1).all())

    @property
    def covering_level(self) -> float | None:
        """The lowest level c that tolerates the largest error since the flight settled.

        That {V <= c} is not left under such errors is proved.  None: there is no such level,
        or the flight never settled.
        """
        found, highest = self.certified.certificate, self.settled_figures()["V_max_settled"]
        # Each margin holds on a closed interval of levels, so at its lower end.
        levels, e_star = np.array(found.levels[:-1]), np.array(found.e_star)
        high = levels >= (np.inf if highest is None else highest)
        return self.lowest_covering(levels[high], e_star[high])

    def summary(self) -> dict[str, Any]:
        """Returns the figures by plain names; None where the flight never settled.

        Errors are parts of the speed.  `inside_from_s` is the time from which on no error was
        outside of the margin; None: the last one was.
        """
        proved, figures = self.certified.conditions, self.settled_figures()
        settled, highest = self.log[self.settled], figures["V_max_settled"]
        return {
            "piece": self.piece,
            "inside_margin": self.inside,
            **figures,
            "worst_ratio": None if highest is None else float(settled["ratio"].max()),
            "time_outside_s": None if highest is None else self._time_outside(settled),
            "covering_level": self.covering_level,
            "stayed_in_tube": None if highest is None else highest <= proved.c_in,
            "stayed_in_certified_set": bool((self.log["V"] <= proved.c_out).all()),
            "inside_from_s": self._inside_from(),
            "way_in": self._way_in(),
        }

    def _way_in(self) -> dict[str, Any] | None:
        """Returns the figures from the take-off to the tube; None: there is no such sample."""
        way = self.log[~self.settled & (self.log["time"] >= TAKE_OFF_S)]
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
        outside = np.flatnonzero(self.log["ratio"] >= 1)
        first = outside[-1] + 1 if len(outside) else 0
        return float(self.log["time"].iloc[first]) if first < len(self.log) else None

    def _time_outside(self, samples: pd.DataFrame) -> float:
        period = float(np.diff(self.log["time"][:2])[0])
        return float((samples["ratio"] >= 1).sum() * period)


def flight_margin(certified: CertifiedField, flight: PieceFlight, speed: float) -> FlightMargin:
    """Returns the velocity error of a flight against a certificate; see `FlightMargin`.

    Args:
        certified: The field, and what is proved of it.
        flight: Along one piece; from `fly` with the field in metres.
        speed: Commanded speed, m/s.
    """
    log, scale = flight.log, certified.scale
    V = certified.V(positions_of(log, 2) / scale)
    error, e_star = velocity_error(log, certified.field, speed, scale), certified.e_star(V)
    with np.errstate(divide="ignore"):
        ratio = error / e_star
    in_tube = (certified.certificate.levels[0] >= V) & (log["time"].to_numpy() >= TAKE_OFF_S)
    return FlightMargin(
        flight.piece,
        log.assign(V=V, error=error, e_star=e_star, ratio=ratio),
        np.logical_or.accumulate(in_tube),
        certified=certified,
    )


def margin_summary(flights: Sequence[FlightMargin]) -> dict[str, Any]:
    """Returns the worst of flights against one certificate, and what none of them covers."""
    found, proved = flights[0].certified.certificate, flights[0].certified.conditions
    pieces = [flight.summary() for flight in flights]
    worst = ("error_max", "worst_ratio", "time_outside_s", "covering_level")
    every = ("inside_margin", "stayed_in_tube", "stayed_in_certified_set")
    return {
        **{name: all(piece[name] for piece in pieces) for name in every},
        **{name: worst_of(pieces, name) for name in worst},
        "certified": found.certified,
        "field_digest": found.field_digest,
        "c_in": proved.c_in,
        "c_out": proved.c_out,
        "e_star_tube": found.e_star[0],
        "e_star_max": found.e_star_max,
        "what_it_does_not_cover": list(NOT_COVERED),
        "pieces": pieces,
    }
