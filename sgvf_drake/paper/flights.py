"""Fig. 3: the quadrotor flies both scenarios from branch to branch."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.exceptions import ConfigurationError, SgvfError
from sgvf_drake.experiments.figures.runs import tour_figure
from sgvf_drake.experiments.flight import FORCE_COLUMNS, TAKE_OFF_S, velocities_of
from sgvf_drake.experiments.intervals import interval_columns, over_seeds
from sgvf_drake.experiments.tour import TourResult, fly_tour, speed_figures
from sgvf_drake.experiments.workbench import Row, Workbench
from sgvf_drake.fields import load_guiding_field
from sgvf_drake.metrics import REACH_DISTANCE
from sgvf_drake.paper.claims import Claim, Claims, Count, Judged, Rows, Span, Verdict
from sgvf_drake.paper.experiment import FOLDER, Exhibit, Experiment, run_trials
from sgvf_drake.paper.training import trained
from sgvf_drake.paths import make_shape, shape_path
from systems import Feasibility, FieldForSpeed, QuadrotorParameters, SensorParameters

FIELD, LOG = "field.safetensors", "flight.parquet"
MM = 1e3
# The speed stays below this many times the commanded one.  How slow the field is belongs to
# another claim.
FASTEST = 1.5
# Within one sample of 10 ms the velocity changes by at most this part of the commanded speed,
# and a force by this part of its limit; more is a jump.
LARGEST_STEP = 0.05
# Columns of what says whether a flight was smooth.
MOTION = (
    *("speed_min_m_s", "speed_max_m_s", "velocity_step_m_s"),
    *("force_min_n", "force_max_n", "force_step_n", "limit_n"),
    *("rms_m", "acceleration_max_m_s2", "jerk_rms_m_s3"),
)
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


@dataclass(frozen=True)
class FlightTrial:
    """A tour of pieces, numbered from 0, of a shape; the rest is as in `Flights`."""

    shape: str
    recipe: str
    seed: int
    tour: tuple[int, ...]
    speed: float
    laps: float


def measure_flight(trial: FlightTrial, folder: Path) -> Row:
    """Trains a field and flies it by noisy measurements; leaves the field and the log.

    A flight that loses control is a result as well: its row has the text of the error.

    Returns:
        error; completed, summary, feasibility and real_time_factor: as of the tour; rms_m,
        max_m: root mean square and largest cross-track error on the worst piece; tolerance_m:
        the error up to which a piece counts as followed; limit_n: the largest force of a
        propeller; and what `motion_of` does.
    """
    cloud, path = make_shape(trial.shape, seed=trial.seed)
    field = trained(cloud, trial.recipe, trial.seed).guiding_field
    field.save(folder / FIELD)
    try:
        result = fly_tour(
            field,
            path,
            trial.tour,
            speed=trial.speed,
            laps=trial.laps,
            sensors=SensorParameters(),
            seed=trial.seed,
        )
    except SgvfError as error:
        return {"error": str(error), "completed": False, "summary": None}
    log, summary = result.log.astype(np.float32), result.summary()
    log.to_parquet(folder / LOG, index=False)
    return {
        "error": None,
        "completed": result.completed,
        "summary": summary,
        "feasibility": asdict(result.feasibility),
        "real_time_factor": result.real_time_factor,
        "rms_m": max((leg["cross_track_rms_m"] for leg in result.legs), default=None),
        "max_m": max((leg["cross_track_max_m"] for leg in result.legs), default=None),
        "tolerance_m": REACH_DISTANCE * cloud.unit_length,
        "limit_n": QuadrotorParameters().max_propeller_force,
        **motion_of(log),
    }


def motion_of(log: pd.DataFrame) -> dict[str, float]:
    """Returns the motion and the motor inputs of a flight after its take-off.

    Args:
        log: The log of `fly` or `fly_tour`.

    Returns:
        Least and top speed; acceleration_max_m_s2: the largest acceleration, from one
        sample to the next; jerk_rms_m_s3: the root mean square of its rate of change, in the
        horizontal plane; velocity_step_m_s: the largest change of the velocity in one sample
        (10 ms); least and largest force of a propeller; force_step_n: the largest change of
        it in one sample.
    """
    flown = log[log["time"] > TAKE_OFF_S].astype(np.float64)
    times, velocity = flown["time"].to_numpy(), velocities_of(flown)
    forces = flown[list(FORCE_COLUMNS)].to_numpy()
    period = (times[-1] - times[0]) / (len(times) - 1)
    steps = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    jerk = np.diff(velocity[:, :2], 2, axis=0) / period**2
    return {
        **speed_figures(flown),
        "acceleration_max_m_s2": float(steps.max() / period),
        "jerk_rms_m_s3": float(np.sqrt((jerk**2).sum(axis=1).mean())),
        "velocity_step_m_s": float(steps.max()),
        "force_min_n": float(forces.min()),
        "force_max_n": float(forces.max()),
        "force_step_n": float(np.abs(np.diff(forces, axis=0)).max()),
    }


@dataclass
class Flights(Experiment):
    """Flies tours of the pieces of shapes, by noisy and late measurements.

    Attributes:
        shapes: Names of `SHAPES`, in metres.
        tours: For each shape, the pieces from 1 on in the order of the flight, as in "1,2,1".
        speed: Commanded speed, m/s.
        laps: Laps of each piece.
        seeds: Seeds of the clouds, the trainings by the robust recipe and the noise.
        paper_seeds: The same of those by the paper's recipe.
    """

    shapes: list[str] = field(default_factory=lambda: ["concentric-flight", "separated-flight"])
    tours: list[str] = field(default_factory=lambda: ["1,2,1", "1,2"])
    speed: float = 0.45
    laps: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    paper_seeds: list[int] = field(default_factory=lambda: [0, 1])

    def measure(self, bench: Workbench) -> Rows:
        """Runs the trials.

        Raises:
            ConfigurationError: If a tour is none of its shape, or there are more or fewer
                tours than shapes.
        """
        if len(self.tours) != len(self.shapes):
            raise ConfigurationError(
                f"there are {len(self.shapes)} shapes to fly, but {len(self.tours)} tours"
            )
        tours = [
            _pieces(tour, len(shape_path(shape).pieces))
            for shape, tour in zip(self.shapes, self.tours, strict=True)
        ]
        trials = [
            FlightTrial(shape, recipe, seed, tour, self.speed, self.laps)
            for recipe, seeds in self._recipes().items()
            for shape, tour in zip(self.shapes, tours, strict=True)
            for seed in seeds
        ]
        return {"flights": run_trials(bench, measure_flight, trials, "flights")}

    def _recipes(self) -> Mapping[str, Sequence[int]]:
        """Returns the seeds of each recipe that is flown."""
        recipes = {"robust": self.seeds, "paper": self.paper_seeds}
        return {recipe: seeds for recipe, seeds in recipes.items() if seeds}

    def claims(self) -> Sequence[Claim]:
        return CLAIMS.of_recipes(self._recipes())

    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        """Draws the first flight of each shape and recipe that has one."""
        flown = rows["flights"][rows["flights"]["error"].isna()]
        firsts = flown.groupby(["recipe", "shape"], sort=False).head(1)
        return [_flight_figure(flight) for flight in firsts.to_dict("records")]

    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        return [
            Exhibit("flights_parts", PARTS_CAPTION, parts_table(rows["flights"])),
            Exhibit("flights_all", FLIGHTS_CAPTION, flights_table(rows["flights"])),
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


def _flight_figure(flight: Mapping[Any, Any]) -> Exhibit:
    shape, recipe, seed, speed = (flight[key] for key in ("shape", "recipe", "seed", "speed"))
    cloud, _ = make_shape(shape, seed=seed)
    folder = flight[FOLDER]
    result = TourResult(
        log=pd.read_parquet(folder / LOG),
        legs=flight["summary"]["legs"],
        transfers=flight["summary"]["transfers"],
        completed=flight["completed"],
        feasibility=Feasibility(**flight["feasibility"]),
        parameters=QuadrotorParameters(),
        real_time_factor=flight["real_time_factor"],
    )
    pieces = ", ".join(str(piece + 1) for piece in flight["tour"])
    return Exhibit(
        f"flight_{shape}_{recipe}",
        f"{shape}, recipe {recipe}, seed {seed}: trajectory, cross-track error, velocity and "
        f"propeller forces of one flight along the pieces {pieces} at {speed:g} m/s by noisy "
        f"and late measurements; it is {'' if result.completed else 'not '}completed.",
        tour_figure(FieldForSpeed(load_guiding_field(folder / FIELD), speed), cloud, result),
    )


def parts_table(flights: pd.DataFrame) -> pd.DataFrame:
    """Returns one row a shape, recipe and part of the flight, over the flights that have it."""
    parts = pd.DataFrame(
        {"shape": flight["shape"], "recipe": flight["recipe"], "part": name, **part}
        for flight in flights[flights["error"].isna()].to_dict("records")
        for name, part in _named_parts(flight["summary"])
    )
    if parts.empty:
        return parts
    limit = QuadrotorParameters().max_propeller_force
    return over_seeds(
        parts,
        ("shape", "recipe", "part"),
        lambda own: {
            "flights": len(own),
            **interval_columns("RMS, mm", MM * own["cross_track_rms_m"]),
            **interval_columns("largest, mm", MM * own["cross_track_max_m"]),
            **interval_columns("time, s", own["end_s"] - own["begin_s"]),
            "speed, m/s": _range(own["speed_min_m_s"].min(), own["speed_max_m_s"].max(), ".2f"),
            "force, %": _range(
                100 * own["motor_force_min_n"].min() / limit,
                100 * own["motor_force_max_n"].max() / limit,
                ".1f",
            ),
        },
    )


def _named_parts(summary: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Returns the legs and transfers of a flight in their order, by a name each.

    A transfer follows no piece, so it has no cross-track error.
    """
    parts = [("piece", leg) for leg in summary["legs"]]
    parts += [("transfer to", transfer) for transfer in summary["transfers"]]
    parts.sort(key=lambda part: part[1]["begin_s"])
    names = [f"{kind} {part['piece'] + 1}" for kind, part in parts]
    return [
        (f"{name} again" if name in names[:number] else name, part)
        for number, (name, (_, part)) in enumerate(zip(names, parts, strict=True))
    ]


def flights_table(flights: pd.DataFrame) -> pd.DataFrame:
    """Returns one row a flight, with nothing but its outcome where it lost control."""
    motion = flights.reindex(columns=MOTION).astype(float)
    force = 100 * motion.filter(regex="^force").div(motion["limit_n"], axis=0)
    speeds = zip(motion["speed_min_m_s"], motion["speed_max_m_s"], strict=True)
    forces = zip(force["force_min_n"], force["force_max_n"], strict=True)
    return pd.DataFrame(
        {
            **{name: flights[name] for name in ("shape", "recipe", "seed")},
            "outcome": [outcome(flight) for flight in flights.to_dict("records")],
            "RMS, mm": MM * motion["rms_m"],
            "speed, m/s": [_range(*ends, ".2f") for ends in speeds],
            "largest acceleration, m/s^2": motion["acceleration_max_m_s2"],
            "jerk (RMS), m/s^3": motion["jerk_rms_m_s3"],
            "force, %": [_range(*ends, ".1f") for ends in forces],
            "force step, %": force["force_step_n"],
        }
    )


def _range(low: float, high: float, digits: str) -> str | None:
    return None if np.isnan(low) else f"{low:{digits}}-{high:{digits}}"


def outcome(flight: Mapping[Any, Any]) -> str:
    """Says what became of a flight."""
    if not pd.isna(flight["error"]):
        return "lost control"
    if not flight["completed"]:
        return f"{len(flight['summary']['legs'])} of {len(flight['tour'])} pieces"
    return "completed" if flight["rms_m"] <= flight["tolerance_m"] else "strayed"


SECTION = "Section V-B, Fig. 3"
CLAIMS = Claims()
"""What is claimed of each recipe."""


@CLAIMS.add("flights-branches", SECTION)
def _branches(rows: Rows) -> Judged:
    """One field lets a quadrotor follow several branches in turn {}."""
    # Counts the flights along all pieces; tells how near they were, and of the others.
    flights = rows["flights"]
    outcomes = [outcome(flight) for flight in flights.to_dict("records")]
    follows = np.array(outcomes) == "completed"
    count = Count.of(follows)
    found: dict[str, Any] = {"flights that followed all of their pieces": count}
    if follows.any():
        own = flights[follows]
        found["their largest cross-track RMS, mm"] = float(MM * own["rms_m"].max())
        found["their largest error, mm"] = float(MM * own["max_m"].max())
    others = [
        f"{shape} seed {seed}, {what}"
        for shape, seed, what in zip(flights["shape"], flights["seed"], outcomes, strict=True)
        if what != "completed"
    ]
    if others:
        found["the others"] = ", ".join(others)
    return found, Verdict.every(count)


@CLAIMS.add("flights-smooth", SECTION)
def _smooth(rows: Rows) -> Judged:
    """Velocity and motor inputs remain smooth and bounded {}."""
    # Counts the flights whose velocity and forces stay within bounds, without jumps.
    flights = rows["flights"]
    # All is NaN of a flight that lost control, which compares with nothing.
    figures = flights.reindex(columns=MOTION).astype(float)
    by_speed = figures.div(flights["speed"], axis=0)
    by_limit = figures.div(figures["limit_n"], axis=0)
    smooth = Count.of(
        (by_speed["speed_max_m_s"] <= FASTEST)
        & (by_limit["force_min_n"] > 0)
        & (by_limit["force_max_n"] < 1)
        & (by_speed["velocity_step_m_s"] <= LARGEST_STEP)
        & (by_limit["force_step_n"] <= LARGEST_STEP)
    )
    found: dict[str, Any] = {"smooth flights": smooth}
    if figures["limit_n"].notna().any():
        speed = by_speed["speed_min_m_s"].min(), by_speed["speed_max_m_s"].max()
        force = by_limit["force_min_n"].min(), by_limit["force_max_n"].max()
        found["speed of the commanded one"] = Span(*speed, percent=True)
        found["propeller forces of their limit"] = Span(*force, percent=True)
        found["velocity step in 10 ms, %"] = float(100 * by_speed["velocity_step_m_s"].max())
        found["force step in 10 ms, %"] = float(100 * by_limit["force_step_n"].max())
    return found, Verdict.every(smooth)
