"""Monte Carlo: many flights that differ by chance, how many succeed, and how well.

The flight of a number is a function of the experiment's seed and of that number alone, and so
is its row, to the last bit, wherever it is flown and whatever was flown before.
"""

from collections import Counter
from concurrent.futures import Executor
import dataclasses
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
import hashlib
import json
from os import PathLike
from pathlib import Path
import threading
import time
from typing import Any

from matplotlib.figure import Figure
import numpy as np
import pandas as pd
from pydrake.systems.framework import Diagram
from scipy import stats

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import (
    ConfigurationError,
    ExperimentError,
    LostControlError,
)
from sgvf_drake.experiments.certified import CertifiedField, certificate_file
from sgvf_drake.experiments.distributions import (
    Distributions,
    flight_seed,
    load_distributions,
)
from sgvf_drake.experiments.figures.monte_carlo import monte_carlo_figure
from sgvf_drake.experiments.figures.runs import flight_figure
from sgvf_drake.experiments.flight import (
    LOG_PERIOD,
    POSITION_COLUMNS,
    TAKE_OFF_S,
    FlightSpec,
    check_feasibility,
    flight_diagram,
    flown_pieces,
    positions_of,
    simulate,
)
from sgvf_drake.experiments.fly import FlightResult, PieceFlight
from sgvf_drake.experiments.intervals import CONFIDENCE, fraction_interval
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    check_results,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.runs import open_guiding_field
from sgvf_drake.experiments.scene import View
from sgvf_drake.experiments.store import Row
from sgvf_drake.experiments.velocity_error import flight_margin
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.metrics import REACH_DISTANCE, SETTLE_DISTANCE, follow_metrics
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import (
    DEFAULT_GAINS,
    DISTURBANCE_BANDWIDTH,
    Disturbance,
    Feasibility,
    SensorParameters,
)
from systems.guidance import DEFAULT_ALTITUDE, DEFAULT_SPEED

LOST, AWAY, LEFT, STALLED = (
    *("lost control", "never reached the path"),
    *("left the path again", "stalled"),
)
"""Why a flight is no success."""

# Columns of a flight, and with a certificate.
MEASURED = (
    *("reached_s", "cross_track_rms_m", "cross_track_max_m"),
    *("end_time", "end_x", "end_y", "end_z"),
)
PROVED = ("stayed_between_walls", "inside_margin")

TABLE, FIGURE, DISTRIBUTIONS = "flights.parquet", "montecarlo.png", "distributions.yaml"
FILES = (SUMMARY, TABLE, FIGURE, DISTRIBUTIONS)
TRIALS = "trials"
# Of the flights that are named in the summary.
WORST = 5
# Resamples of the bootstrap.
RESAMPLES = 2000
# The direction of the path at a start is that between points so far before and after, U.
NEARBY = 0.01
# Diagrams that one process keeps; more structures than that are built again and again.
DIAGRAMS = 32


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """A Monte Carlo experiment with quadrotors: what all of its flights have in common.

    Attributes:
        field: The file of the field, or the folder of its training; not a directed one.
        seed: From 0 on.
        speed: Commanded speed, m/s.
        altitude: Height of the flights where the field is planar, m.
        duration: How long each flight takes, s; None: enough for two laps, or to the end.
        compensate: Whether the controller estimates what disturbs it, and makes up for it.
        scale: Metres in one unit of the waypoints.
        certificate: Results of `run_certify`; None: nothing is proved.
        distributions: What differs between the flights.
    """

    field: str
    seed: int = 0
    speed: float = DEFAULT_SPEED
    altitude: float = DEFAULT_ALTITUDE
    duration: float | None = None
    compensate: bool = False
    scale: float = 1.0
    certificate: str | None = None
    distributions: Distributions = dataclasses.field(default_factory=Distributions)

    def plan(self, numbers: range) -> list["PlannedFlight"]:
        """Draws flights.

        Args:
            numbers: Those of the flights, from 0 on.

        Raises:
            ConfigurationError: If a value that was drawn cannot be used; the message names the
                flight.
            FieldFileError: If there is no field.
        """
        if self.seed < 0:
            raise ConfigurationError(f"the seed must not be negative, but is {self.seed}")
        self.distributions.check()
        shared = self._shared()
        site = _open_site(shared, self.speed)
        gains = DEFAULT_GAINS._replace(
            disturbance_bandwidth=DISTURBANCE_BANDWIDTH if self.compensate else 0.0
        )
        common = FlightSpec(
            self.speed, altitude=self.altitude, duration=self.duration, gains=gains
        )
        flights = []
        for number in numbers:
            drawn = self.distributions.draw(self.seed, number)
            try:
                piece, spec = _drawn_flight(site, common, drawn)
            except ConfigurationError as error:
                raise ConfigurationError(f"flight {number} as it was drawn: {error}") from None
            spec = replace(spec, seed=flight_seed(self.seed, number, "noise"))
            flights.append(PlannedFlight(number, shared, piece, spec))
        return flights

    def _shared(self) -> "_Shared":
        path = str(Path(self.field).absolute())
        certificate = None
        if self.certificate is not None:
            file = certificate_file(self.certificate)
            if file is None:
                raise ConfigurationError(f"there is no certificate in {self.certificate}")
            certificate = str(file.absolute()), hashlib.sha256(file.read_bytes()).hexdigest()
        digest = field_digest(open_guiding_field(path))
        return _Shared(path, digest, self.scale, certificate)


@dataclass(frozen=True)
class _Shared:
    """The files under all flights of an experiment, with the digests of what is in them."""

    field: str
    digest: str
    scale: float
    certificate: tuple[str, str] | None

    @property
    def certificate_file(self) -> str | None:
        """The file of the certificate."""
        return None if self.certificate is None else self.certificate[0]


@dataclass(frozen=True)
class PlannedFlight:
    """A flight of an experiment, before it is flown.

    Attributes:
        number: From 0 on.
        shared: The files under it.
        piece: The piece that it begins at.
        spec: How it is flown.
    """

    number: int
    shared: _Shared
    piece: int
    spec: FlightSpec

    def __str__(self) -> str:
        return f"flight {self.number}"

    @property
    def columns(self) -> Row:
        """What is known before it is flown, by the columns of the table."""
        spec = self.spec
        assert spec.start is not None
        assert spec.disturbance is not None
        air = asdict(spec.disturbance)
        vectors = {"start": spec.start, "wind": air.pop("wind")}
        return {
            **{"number": self.number, "seed": spec.seed, "piece": self.piece},
            **{
                f"{name}_{axis}": value
                for name, vector in vectors.items()
                for axis, value in zip(POSITION_COLUMNS, vector, strict=True)
            },
            **air,
            **(asdict(spec.sensors) if spec.sensors else {}),
        }


@dataclass(frozen=True, eq=False)
class _Site:
    """What the flights of an experiment share in one process, in metres."""

    field: GuidingField
    reference: ReferencePath
    feasibility: Feasibility
    certified: CertifiedField | None


@lru_cache(maxsize=4)
def _open_site(shared: _Shared, speed: float) -> _Site:
    """Reads the field, and what it is measured and proved by.

    Raises:
        FieldFileError: If there is no field.
        ExperimentError: If it is not the one of the experiment.
    """
    loaded = open_guiding_field(shared.field)
    if field_digest(loaded) != shared.digest:
        raise ExperimentError(f"{shared.field} is not the field of these flights any more")
    metric = loaded.rescaled(shared.scale)
    reference = choose_reference(loaded)[0].rescaled(shared.scale)
    certified = None
    if shared.certificate_file is not None:
        file = shared.certificate_file
        certified = CertifiedField.open(loaded, file, speed, shared.scale)
    craft = FlightSpec(speed).craft
    return _Site(
        metric, reference, check_feasibility(metric, reference, speed, craft), certified
    )


@lru_cache(maxsize=DIAGRAMS)
def _open_diagram(site: _Site, structure: FlightSpec, thread: int) -> Diagram:
    """Returns the diagram of all flights of a structure; each thread has its own."""
    return flight_diagram(site.field, structure)


def _drawn_flight(
    site: _Site, common: FlightSpec, drawn: dict[str, float]
) -> tuple[int, FlightSpec]:
    """Returns the piece and the spec of a flight from its values."""
    parts: dict[str, dict[str, Any]] = {"start": {}, "disturbance": {}, "sensors": {}}
    for name, value in drawn.items():
        part, _, key = name.partition(".")
        parts[part][key] = value
    air = parts["disturbance"]
    wind = tuple(air.pop(f"wind_{axis}") for axis in "xyz")
    sensors = SensorParameters(**parts["sensors"]) if parts["sensors"] else None
    piece, place = _start(site, common.altitude, **parts["start"])
    return piece, replace(
        common,
        start=tuple(place.tolist()),
        disturbance=Disturbance(wind=wind, **air),
        sensors=sensors,
    ).along(site.field, site.reference, piece)


def _start(
    site: _Site, altitude: float, along: float, beside: float, above: float
) -> tuple[int, FloatArray]:
    """Returns the piece and the place (3,) of a start; see `StartDistributions`."""
    if not 0.0 <= along <= 1.0:
        raise ConfigurationError(f"start.along must be from 0 to 1, not {along}")
    unit, pieces = site.field.cloud.unit_length, flown_pieces(site.field, site.reference)
    ends = np.cumsum(site.reference.lengths[pieces])
    index = min(int(np.searchsorted(ends, along * ends[-1], side="right")), len(pieces) - 1)
    path = site.reference.pieces[pieces[index]]
    arc = along * ends[-1] - (ends[index] - path.length)
    near = arc + NEARBY * unit * np.array([-1.0, 0.0, 1.0])
    near = near % path.length if path.closed else np.clip(near, 0.0, path.length)
    before, place, after = path.at(near)
    ahead = after[:2] - before[:2]
    left = np.array([-ahead[1], ahead[0]]) / max(float(np.linalg.norm(ahead)), 1e-12)
    start = np.append(place, altitude) if len(place) == 2 else place
    return pieces[index], start + np.append(beside * unit * left, above)


def measure_flight(flight: PlannedFlight, folder: Path) -> Row:
    """Flies a flight and judges it.

    Returns:
        success, and the reason if it is none; reached_s: when the path was reached;
        cross_track_rms_m and cross_track_max_m: the error since then; end_time, end_x, end_y,
        end_z: the end, in s and m; and with a certificate `PROVED`, as `FlightMargin` has it.
    """
    return fly_planned(flight)[0]


def fly_planned(flight: PlannedFlight) -> tuple[Row, pd.DataFrame | None]:
    """Returns the row of `measure_flight`, and the log as far as there is one."""
    spec, site = flight.spec, _open_site(flight.shared, flight.spec.speed)
    diagram = _open_diagram(site, _structure_of(spec), threading.get_ident())
    log: pd.DataFrame | None = None
    row: Row = {"success": False, "reason": LOST, **dict.fromkeys(MEASURED)}
    try:
        log = simulate(
            *(site.field, site.reference, spec, flight.piece),
            feasibility=site.feasibility,
            diagram=diagram,
        ).log
        row |= _judged(log, site, spec.speed)
    except LostControlError as error:
        log = error.log
    if log is not None:
        last = log.iloc[-1]
        row |= {f"end_{name}": float(last[name]) for name in ("time", *POSITION_COLUMNS)}
    if site.certified is not None:
        row |= _proved(log, site.certified, flight)
    return row, log


def _structure_of(spec: FlightSpec) -> FlightSpec:
    """Returns what a flight has in common with all that are flown in the same diagram."""
    assert spec.disturbance is not None
    return replace(
        spec,
        start=None,
        duration=None,
        seed=0,
        disturbance=spec.disturbance.structure,
        sensors=spec.sensors and spec.sensors.structure,
    )


def _judged(log: pd.DataFrame, site: _Site, speed: float) -> Row:
    """Says whether a flight under control reached the path and followed it from then on."""
    times, errors = log["time"].to_numpy(), log["cross_track_error"].to_numpy()
    unit = site.field.cloud.unit_length
    near = errors <= REACH_DISTANCE * unit
    if not near.any():
        return {"reason": AWAY}
    first = int(np.argmax(near))
    largest = float(errors[first:].max())
    positions = positions_of(log, site.field.dim)[:, None, :]
    followed = follow_metrics(
        *(times, positions, unit, site.field.cloud.box, site.reference, speed),
        ends=site.field.ends,
    )
    reason = None
    if largest > SETTLE_DISTANCE * unit:
        reason = LEFT
    elif followed.stalled[0]:
        reason = STALLED
    return {
        "success": reason is None,
        "reason": reason,
        "reached_s": float(times[first]),
        "cross_track_rms_m": float(np.sqrt((errors[first:] ** 2).mean())),
        "cross_track_max_m": largest,
    }


def _proved(log: pd.DataFrame | None, certified: CertifiedField, flight: PlannedFlight) -> Row:
    """Says whether a flight stayed inside what is proved; None: it never came between walls."""
    if log is None:
        return dict.fromkeys(PROVED)
    flown = PieceFlight(flight.piece, log, {})
    margin = flight_margin(certified, flown, flight.spec.speed).summary()
    return {name: margin[name] for name in PROVED}


def run_monte_carlo(
    experiment: MonteCarlo,
    out: str | PathLike[str],
    *,
    flights: int = 100,
    jobs: int = 1,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies the first flights of an experiment; leaves their table, a figure, the summary.

    Each flight is stored when it ends, in `trials` in the folder.  A run that was interrupted
    goes on where it was, and a run of more flights only flies those that are new.

    Args:
        experiment: The experiment.
        out: The folder.
        flights: How many, at least 1.
        jobs: Processes that fly at the same time; 1: this one.
        executor: Flies in place of processes of this machine; see `workers_of`.
        overwrite: Whether results in `out` may be replaced.  Stored flights stay.
        progress: Told how many flights have ended.

    Raises:
        ConfigurationError: If a value cannot be used.
        OutputExistsError: If there are results already.
        ExperimentError: If flights failed, which losing control is not.
    """
    if flights < 1:
        raise ConfigurationError(f"the number of flights must be at least 1, not {flights}")
    out = Path(out)
    check_results(out, FILES, overwrite=overwrite)
    begin = time.perf_counter()
    planned = experiment.plan(range(flights))
    bench = Workbench(out / TRIALS, jobs, progress, executor=executor)
    records = bench.run(measure_flight, planned, "flights")
    wall_s = time.perf_counter() - begin
    table = pd.DataFrame(
        {**flight.columns, **record.row}
        for flight, record in zip(planned, records, strict=True)
    )
    site = _open_site(planned[0].shared, experiment.speed)
    summary = {
        **summary_of(table),
        "wall_s": wall_s,
        "flown": bench.measured,
        "flights_per_s": bench.measured / wall_s,
        "experiment": _settings(experiment, planned[0].shared),
        "field_digest": planned[0].shared.digest,
        **origin(site.field),
    }
    with result_folder(out, FILES, overwrite=overwrite) as folder:
        table.to_parquet(folder / TABLE, index=False)
        save_figure(monte_carlo_figure(table, site.reference), folder / FIGURE)
        yaml = experiment.distributions.to_yaml()
        (folder / DISTRIBUTIONS).write_text(yaml, encoding="utf-8")
        write_summary(folder, summary)
    return summary


def summary_of(table: pd.DataFrame) -> dict[str, Any]:
    """Returns what flights say together, by the names of `summary.json`.

    Intervals are those of 95 %: Wilson's of the fraction of successes, and of the error a
    bootstrap over the flights.  The error is the root mean square over the successful ones.

    Args:
        table: One row a flight.
    """
    successes = int(table["success"].sum())
    fraction, low, high = fraction_interval(successes, len(table))
    rms, rms_low, rms_high = _rms_interval(table["cross_track_rms_m"][table["success"]])
    order = table.assign(error=table["cross_track_rms_m"].astype(float).fillna(np.inf))
    worst = order.sort_values(["success", "error"], ascending=[True, False], kind="stable")
    summary = {
        "flights": len(table),
        "success_fraction": fraction,
        "success_low": low,
        "success_high": high,
        "reasons": dict(Counter(table["reason"].dropna())),
        "cross_track_rms_m": rms,
        "cross_track_rms_low_m": rms_low,
        "cross_track_rms_high_m": rms_high,
        "worst": worst["number"].head(WORST).tolist(),
    }
    if PROVED[0] in table:
        came = table[table[PROVED[0]].notna()]
        counts = {name: int(came[name].sum()) for name in PROVED}
        summary["certificate"] = {"came_between_walls": len(came), **counts}
    return summary


def _rms_interval(errors: pd.Series) -> tuple[float | None, float | None, float | None]:
    """Returns the root mean square of errors, and its interval where there are several."""
    squares = errors.to_numpy(dtype=np.float64) ** 2
    if len(squares) == 0:
        return None, None, None
    rms = float(np.sqrt(squares.mean()))
    if len(squares) == 1:
        return rms, None, None
    found = stats.bootstrap(
        (squares,),
        np.mean,
        confidence_level=CONFIDENCE,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return rms, float(np.sqrt(found.low)), float(np.sqrt(found.high))


def _settings(experiment: MonteCarlo, shared: _Shared) -> dict[str, Any]:
    """Returns the experiment as plain values, but for the distributions."""
    names = [one.name for one in fields(experiment) if one.name != "distributions"]
    found = {name: getattr(experiment, name) for name in names}
    # Wherever somebody is who flies one again.
    return {**found, "field": shared.field, "certificate": shared.certificate_file}


def replay_flight(
    out: str | PathLike[str],
    number: int,
    field: str | PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies one flight of an experiment again; leaves its log, a figure, a page, the summary.

    They are in the folder `replay_NUMBER` beside the results.  The page shows a second flight,
    whose pictures divide the steps of the integrator, and which differs by that.

    Args:
        out: The folder of the results of `run_monte_carlo`.
        number: That of the flight, which may be one that the experiment did not fly.
        field: Where the field is now; None: where it was.
        overwrite: Whether an earlier replay may be replaced.
        progress: Told how far the flight is.

    Returns:
        The row of the flight, and `same`: whether it is the stored one to the last bit; None:
        there is none.

    Raises:
        ConfigurationError: If there are no such results, or no such flight.
        ExperimentError: If the field has changed.
        OutputExistsError: If there is an earlier replay.
    """
    out = Path(out)
    experiment, digest = _stored_experiment(out)
    if field is not None:
        experiment = replace(experiment, field=str(field))
    (flight,) = experiment.plan(range(number, number + 1))
    if flight.shared.digest != digest:
        raise ExperimentError(f"{flight.shared.field} is not the field of {out}")
    names = (SUMMARY, *(f"flight.{suffix}" for suffix in ("parquet", "png", "html")))
    with result_folder(out / f"replay_{number}", names, overwrite=overwrite) as folder:
        row, log = fly_planned(flight)
        if log is not None:
            log.to_parquet(folder / "flight.parquet")
            save_figure(_figure_of(flight, log), folder / "flight.png")
            _show(flight, float(log["time"].iloc[-1]), folder, progress)
        stored = pd.read_parquet(out / TABLE)
        stored = stored[stored["number"] == number]
        row = {**flight.columns, **row}
        same = _same(stored, pd.DataFrame([row])) if len(stored) else None
        summary = {**row, "same": same}
        write_summary(folder, summary)
    return summary


def _stored_experiment(out: Path) -> tuple[MonteCarlo, str]:
    """Returns the experiment whose results are in a folder, and the digest of its field."""
    try:
        summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
        settings, digest = summary["experiment"], summary["field_digest"]
        distributions = load_distributions(out / DISTRIBUTIONS)
        return MonteCarlo(**settings, distributions=distributions), digest
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigurationError(f"there are no results of a Monte Carlo in {out}") from None


def _same(stored: pd.DataFrame, again: pd.DataFrame) -> bool:
    """Whether two rows are equal to the last bit, where nothing is equal to nothing."""
    one, other = (table.astype(object).iloc[0] for table in (stored, again))
    return one.index.equals(other.index) and all(
        a == b or (pd.isna(a) and pd.isna(b)) for a, b in zip(one, other, strict=True)
    )


def _figure_of(flight: PlannedFlight, log: pd.DataFrame) -> Figure:
    site, spec = _open_site(flight.shared, flight.spec.speed), flight.spec
    flown = spec.craft.FlownField(site.field, spec.speed)
    one = PieceFlight(flight.piece, log, {})
    result = FlightResult([one], site.feasibility, spec)
    return flight_figure(flown, site.field.cloud, one, result)


def _show(flight: PlannedFlight, end: float, folder: Path, progress: Progress) -> None:
    """Leaves a page of a flight, until shortly before the vehicle lost control if it did."""
    spec, site = flight.spec, _open_site(flight.shared, flight.spec.speed)
    assert spec.duration is not None
    duration = min(spec.duration, end - LOG_PERIOD if end < spec.duration - LOG_PERIOD else end)
    if duration <= TAKE_OFF_S:
        return
    scene = View(pages=True).scene(folder)
    assert scene is not None
    scene.draw(site.field, spec.speed, spec.altitude)
    simulate(
        *(site.field, site.reference, replace(spec, duration=duration), flight.piece),
        feasibility=site.feasibility,
        page="flight",
        scene=scene,
        progress=progress,
    )
