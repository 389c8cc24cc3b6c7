"""The velocity error of flights, against what level sets of V or walls tolerate.

With the error d = v_WB - speed m(p), a vehicle crosses a curve inward wherever
|d| < speed e*, with e* the smallest inward normal speed of m on the curve: then it cannot leave
what the curve bounds.  The curves are level sets of V with the e* that `verify` has sampled
(`TrackingResult`), or walls with the one that a certificate proves (`FlightMargin`).  The
errors are measured, not bounded.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
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
    "the take-off, in which a vehicle that stands is in error by all of its speed, and the way "
    "to the outermost walls: they are told apart",
    "what happens between the logged times",
    "altitude and attitude: the certificate speaks of the position in the plane",
    "any other flight: the error is measured, of one simulated vehicle, and not bounded",
)


@dataclass(frozen=True, eq=False)
class VelocityErrors:
    """The velocity errors of one flight.

    Attributes:
        piece: Number of the piece in the reference.
        log: As that of the flight, and for each sample the error: |v_WB - speed m(p_WB)| over
            the dimensions of the field, as a part of the speed.
        settled: Which samples, (T,), are those from the first one in the tube, or between
            walls, on.
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
        }
        return {name: None if settled.empty else float(x) for name, x in figures.items()}


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
        flights: One a piece; their logs tell V, too.
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
        error, highest = figures["error_max"], flight.log["V"][flight.settled].max()
        covers = np.asarray(self.margins.e_star) > (np.inf if error is None else error)
        covering = np.asarray(self.margins.levels)[covers]
        return {
            "piece": flight.piece,
            "settled_s": figures["settled_s"],
            "tracking_error_50_percent_m_s": median,
            "tracking_error_99_percent_m_s": high,
            "tracking_error_max_m_s": largest,
            "covered": None if largest is None else largest < self.tolerated,
            "smallest_covering_level": float(covering[0]) if len(covering) else None,
            "V_max_settled": None if error is None else float(highest),
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


@dataclass(frozen=True)
class EnteredWalls:
    """A pair of walls that a flight came between.

    Attributes:
        half_width: Largest distance of the walls from the middle of their tube, m.
        e_star: What they tolerate, as a part of the speed.
        entered_s: When the flight first was between them, after the take-off.
        error_max: Its largest error since then, as a part of the speed.
    """

    half_width: float
    e_star: float
    entered_s: float
    error_max: float

    @property
    def hold(self) -> bool:
        """Whether no error since then could take the flight out from between them."""
        return self.error_max < self.e_star


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightMargin(VelocityErrors):
    """The velocity error of one flight against the margins that a certificate proves.

    The error is that from the certified field.  Where the vehicle flies a wider one
    (`systems.FieldForSpeed`), the difference is a part of the error.

    Attributes:
        certified: What is proved.  The log has two columns more: walls, how many pairs hold
            the vehicle, and e_star, what the innermost of these tolerates (zero beyond all).
            A flight has settled once it is between walls after the take-off.
        walls: The pairs that it came between, those of each piece from the tube outwards.
    """

    certified: CertifiedField
    walls: tuple[EnteredWalls, ...]

    @property
    def positions(self) -> FloatArray:
        """Where the vehicle was, (T, 2) in the unit of the waypoints."""
        return positions_of(self.log, 2) / self.certified.scale

    @property
    def covering_half_width(self) -> float | None:
        """Half-width of the innermost walls that hold the flight, m; None: none do."""
        return min((pair.half_width for pair in self.walls if pair.hold), default=None)

    def summary(self) -> dict[str, Any]:
        """Returns the figures by plain names; None where the flight never settled.

        Errors are parts of the speed.  `inside_margin` tells whether some walls hold it: that
        it cannot leave them under such errors is proved.
        """
        settled = self.log["walls"][self.settled]
        return {
            "piece": self.piece,
            "inside_margin": self.covering_half_width is not None,
            **self.settled_figures(),
            "covering_half_width": self.covering_half_width,
            "stayed_between_walls": None if settled.empty else bool((settled > 0).all()),
            "walls": [asdict(pair) for pair in self.walls],
            "way_in": self._way_in(),
        }

    def _way_in(self) -> dict[str, Any] | None:
        """Returns the figures from the take-off to the walls; None: there is no such sample."""
        way = self.log[~self.settled & (self.log["time"] >= TAKE_OFF_S)]
        if way.empty:
            return None
        return {
            "begin_s": float(way["time"].iloc[0]),
            "end_s": float(way["time"].iloc[-1]),
            "error_max": float(way["error"].max()),
        }


def flight_margin(certified: CertifiedField, flight: PieceFlight, speed: float) -> FlightMargin:
    """Returns the velocity error of a flight against a certificate; see `FlightMargin`.

    Args:
        certified: The field, and what is proved of it.
        flight: Along one piece; from `fly` with the field in metres.
        speed: Commanded speed, m/s.
    """
    log, scale = flight.log, certified.scale
    error = velocity_error(log, certified.field, speed, scale)
    pairs = certified.pairs_around(positions_of(log, 2) / scale)
    walls, flying = pairs.sum(axis=1), log["time"].to_numpy() >= TAKE_OFF_S
    log = log.assign(walls=walls, error=error, e_star=certified.e_star(pairs))
    return FlightMargin(
        flight.piece,
        log,
        np.logical_or.accumulate((walls > 0) & flying),
        certified=certified,
        walls=tuple(_entered(certified, log[flying], pairs[flying])),
    )


def _entered(
    certified: CertifiedField, log: pd.DataFrame, pairs: IntArray
) -> Iterator[EnteredWalls]:
    """Yields the walls that a flight came between, from its log after the take-off."""
    time, error = log["time"].to_numpy(), log["error"].to_numpy()
    for piece, held in zip(certified.certificate.pieces, pairs.T, strict=True):
        half_widths = certified.scale * np.array(piece.wall_half_widths)
        for number, e_star in enumerate(piece.e_star):
            inside = held >= len(piece.e_star) - number
            if inside.any():
                first = int(np.argmax(inside))
                yield EnteredWalls(
                    float(half_widths[number]),
                    e_star,
                    float(time[first]),
                    float(error[first:].max()),
                )


def margin_summary(flights: Sequence[FlightMargin]) -> dict[str, Any]:
    """Returns the worst of flights against one certificate, and what none of them covers."""
    found = flights[0].certified.certificate
    pieces = [flight.summary() for flight in flights]
    return {
        **{
            name: all(piece[name] for piece in pieces)
            for name in ("inside_margin", "stayed_between_walls")
        },
        **{name: worst_of(pieces, name) for name in ("error_max", "covering_half_width")},
        "certified": found.certified,
        "field_digest": found.field_digest,
        "e_star_max": found.e_star_max,
        "what_it_does_not_cover": list(NOT_COVERED),
        "pieces": pieces,
    }
