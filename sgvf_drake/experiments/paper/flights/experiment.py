"""Fig. 3: the quadrotor flies both scenarios from branch to branch."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.feasibility import Feasibility
from sgvf_drake.experiments.figures.tour import tour_figure
from sgvf_drake.paper.intervals import interval_columns
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.flights.claims import Flight, flights_claims
from sgvf_drake.experiments.paper.flights.measures import motion_of
from sgvf_drake.experiments.paper.flights.trials import FIELD, LOG, FlightTrial, measure_flight
from sgvf_drake.experiments.tour import TourResult
from sgvf_drake.experiments.workbench import Record, Workbench
from sgvf_drake.fields import load_field
from sgvf_drake.metrics import REACH_DISTANCE
from sgvf_drake.paths import make_shape, shape_path
from systems import FieldForSpeed, QuadrotorParameters

PARTS_CAPTION = (
    "Parts of the flights, over the seeds; the first piece with the way in from beside the "
    "path, from the first reach on. Least and top of all seeds for speed and force; the force "
    "in per cent of what a propeller can give."
)
FLIGHTS_CAPTION = (
    "Every flight, after the take-off: what became of it (one that was more than 0.1 U off its "
    "pieces, RMS, has strayed), the worst cross-track RMS of them, and how smooth it was. The "
    "jerk is horizontal; a step is a change within 10 ms."
)
MM = 1e3
# Of a leg or a transfer, by the names of `TourResult`.
PART_FIGURES = (
    *("begin_s", "end_s", "cross_track_rms_m", "cross_track_max_m"),
    *("speed_min_m_s", "speed_max_m_s", "motor_force_min_n", "motor_force_max_n"),
)


@dataclass
class Flights:
    """Flies tours of the pieces of shapes, by noisy and late measurements.

    Attributes:
        shapes: Of `SHAPES`, in metres.
        tours: Of each shape: the pieces from 1 on in the order of the flight, as in "1,2,1".
        speed: Commanded speed, m/s.
        laps: Of each piece.
        seeds: Of the clouds, the trainings by the robust recipe and the noise.
        paper_seeds: The same of those by the paper's recipe.
    """

    shapes: list[str] = field(default_factory=lambda: ["concentric-flight", "separated-flight"])
    tours: list[str] = field(default_factory=lambda: ["1,2,1", "1,2"])
    speed: float = 0.45
    laps: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    paper_seeds: list[int] = field(default_factory=lambda: [0, 1])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        trials = [
            FlightTrial(shape, recipe, seed, tour, self.speed, self.laps)
            for recipe, seeds in (("robust", self.seeds), ("paper", self.paper_seeds))
            for shape, tour in zip(self.shapes, self._tours(), strict=True)
            for seed in seeds
        ]
        records = bench.run(measure_flight, trials, "flights")
        flown = list(zip(trials, records, strict=True))
        flights = [make_flight(trial, record) for trial, record in flown]
        return Outcome(
            exhibits=[
                *_figures(flown),
                Exhibit("flights_parts", PARTS_CAPTION, parts_table(flown)),
                Exhibit("flights_all", FLIGHTS_CAPTION, flights_table(flights)),
            ],
            claims=flights_claims(flights),
        )

    def _tours(self) -> list[tuple[int, ...]]:
        """Returns the numbers of the pieces from 0 on, for each shape."""
        if len(self.tours) != len(self.shapes):
            raise ConfigurationError(
                f"there are {len(self.shapes)} shapes to fly, but {len(self.tours)} tours"
            )
        return [
            _pieces(tour, len(shape_path(shape).pieces))
            for shape, tour in zip(self.shapes, self.tours, strict=True)
        ]


def _pieces(tour: str, count: int) -> tuple[int, ...]:
    """Reads a tour of a path of so many pieces, numbered from 1; returns them from 0 on."""
    try:
        pieces = tuple(int(piece) - 1 for piece in tour.split(","))
    except ValueError:
        pieces = (-1,)
    if not all(0 <= piece < count for piece in pieces):
        raise ConfigurationError(
            f"a tour is a list of pieces from 1 to {count} as in '1,2,1', not {tour!r}"
        )
    return pieces


def make_flight(trial: FlightTrial, record: Record) -> Flight:
    """Returns a flight from what its trial found and left."""
    cloud, _ = make_shape(trial.shape, seed=trial.seed)
    row = record.row
    lost = row["error"] is not None
    legs = [] if lost else row["summary"]["legs"]
    return Flight(
        shape=trial.shape,
        recipe=trial.recipe,
        seed=trial.seed,
        error=row["error"],
        completed=not lost and row["completed"],
        legs=(len(legs), len(trial.tour)),
        rms_m=max((leg["cross_track_rms_m"] for leg in legs), default=np.nan),
        max_m=max((leg["cross_track_max_m"] for leg in legs), default=np.nan),
        motion=None if lost else motion_of(pd.read_parquet(record.folder / LOG)),
        tolerance_m=REACH_DISTANCE * cloud.unit_length,
        speed_m_s=trial.speed,
        limit_n=QuadrotorParameters().max_propeller_force,
    )


def flights_table(flights: Sequence[Flight]) -> pd.DataFrame:
    """Returns one row a flight."""
    rows = []
    for flight in flights:
        row = {
            "shape": flight.shape,
            "recipe": flight.recipe,
            "seed": flight.seed,
            "outcome": flight.outcome,
            "RMS, mm": MM * flight.rms_m,
        }
        if flight.motion is not None:
            motion = flight.motion
            row |= {
                "speed, m/s": f"{motion.speed_min_m_s:.2f}-{motion.speed_max_m_s:.2f}",
                "largest acceleration, m/s^2": motion.acceleration_max_m_s2,
                "jerk (RMS), m/s^3": motion.jerk_rms_m_s3,
                "force, %": _percent(motion.force_min_n, motion.force_max_n, flight.limit_n),
                "force step, %": 100 * motion.force_step_n / flight.limit_n,
            }
        rows.append(row)
    return pd.DataFrame(rows)


def parts_table(flown: Sequence[tuple[FlightTrial, Record]]) -> pd.DataFrame:
    """Returns one row a shape, recipe and part of the flight, over the flights that have it."""
    limit = QuadrotorParameters().max_propeller_force
    parts = pd.DataFrame(
        [
            {"shape": trial.shape, "recipe": trial.recipe, **part}
            for trial, record in flown
            for part in _parts(record)
        ],
        # Also where every flight lost control, and there is none.
        columns=["shape", "recipe", "part", *PART_FIGURES],
    )
    rows = []
    for (shape, recipe, name), own in parts.groupby(["shape", "recipe", "part"], sort=False):
        forces = own["motor_force_min_n"].min(), own["motor_force_max_n"].max()
        slow, fast = own["speed_min_m_s"].min(), own["speed_max_m_s"].max()
        rows.append(
            {
                "shape": shape,
                "recipe": recipe,
                "part": name,
                "flights": len(own),
                **interval_columns("RMS, mm", MM * own["cross_track_rms_m"]),
                **interval_columns("largest, mm", MM * own["cross_track_max_m"]),
                **interval_columns("time, s", own["end_s"] - own["begin_s"]),
                "speed, m/s": f"{slow:.2f}-{fast:.2f}",
                "force, %": _percent(*forces, limit),
            }
        )
    return pd.DataFrame(rows)


def _parts(record: Record) -> list[dict[str, object]]:
    """Returns the legs and transfers of a flight in their order, with a name each."""
    if record.row["error"] is not None:
        return []
    summary = record.row["summary"]
    parts = [{"kind": "piece", **leg} for leg in summary["legs"]]
    # A transfer follows no piece, so it has no cross-track error.
    none = {"cross_track_rms_m": np.nan, "cross_track_max_m": np.nan}
    parts += [{"kind": "transfer to", **none, **one} for one in summary["transfers"]]
    parts.sort(key=lambda part: part["begin_s"])
    seen: list[str] = []
    for part in parts:
        name = f"{part['kind']} {part['piece'] + 1}"
        part["part"] = name + (" again" if name in seen else "")
        seen.append(name)
    return parts


def _percent(low: float, high: float, limit: float) -> str:
    return f"{100 * low / limit:.1f}-{100 * high / limit:.1f}"


def _figures(flown: Sequence[tuple[FlightTrial, Record]]) -> list[Exhibit]:
    """Returns the figure of the first flight of each shape and recipe that has one."""
    drawn: dict[tuple[str, str], Exhibit] = {}
    for trial, record in flown:
        key = trial.shape, trial.recipe
        if key in drawn or record.row["error"] is not None:
            continue
        cloud, _ = make_shape(trial.shape, seed=trial.seed)
        result = stored_tour(record)
        pieces = ", ".join(str(piece + 1) for piece in trial.tour)
        drawn[key] = Exhibit(
            f"flight_{trial.shape}_{trial.recipe}",
            f"{trial.shape}, recipe {trial.recipe}, seed {trial.seed}: trajectory, cross-track "
            f"error, velocity and propeller forces of one flight along the pieces {pieces} "
            f"at {trial.speed:g} m/s by noisy and late measurements; it is "
            f"{'completed' if result.completed else 'not completed'}.",
            tour_figure(
                FieldForSpeed(load_field(record.folder / FIELD), trial.speed), cloud, result
            ),
        )
    return list(drawn.values())


def stored_tour(record: Record) -> TourResult:
    """Returns the result of a tour from what its trial found and left."""
    row = record.row
    return TourResult(
        log=pd.read_parquet(record.folder / LOG),
        legs=row["summary"]["legs"],
        transfers=row["summary"]["transfers"],
        completed=row["completed"],
        feasibility=Feasibility(**row["feasibility"]),
        parameters=QuadrotorParameters(),
        real_time_factor=row["real_time_factor"],
    )
