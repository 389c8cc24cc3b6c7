"""One flight of a vehicle: what is asked for, its simulation and its log."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
import time
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from sgvf_drake.arrays import FloatArray
from sgvf_drake.compiling import announced
from sgvf_drake.exceptions import ConfigurationError, LostControlError, NonFiniteValueError
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import DirectedField, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.metrics import REST_WINDOW
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.progress import Progress, no_progress
from systems import (
    DEFAULT_GAINS,
    Branch,
    Disturbance,
    Feasibility,
    Gains,
    HeadingSystem,
    LiveControls,
    MakeFlightDiagram,
    MakeSimulator,
    Quadrotor,
    QuadrotorParameters,
    SensorParameters,
    SetNoiseSeed,
    SetVehicleState,
    StopOnExit,
    SublevelExit,
    Vehicle,
    VehicleNamed,
)
from systems.guidance import DEFAULT_ALTITUDE, DEFAULT_SPEED

LOG_PERIOD = 0.01
POSITION_COLUMNS = ("x", "y", "z")
VELOCITY_COLUMNS = ("vx", "vy", "vz")
COMMAND_COLUMNS = ("vx_command", "vy_command", "vz_command")
FORCE_COLUMNS = Quadrotor.actuation_columns

# The vehicle hovers this many U beside the path at the start.
START_OFFSET = 0.5
# Of a route, the sides that are tried, and what being farther back is worth, U.
START_SIDES, AS_GOOD = 16, 0.05
# Time is added for a way in of this many U, and on an open piece for coming to rest.
WAY_IN = 4.0
REST_S = 3.0
# Time for the take-off, after which motion is judged.
TAKE_OFF_S = 1.0
# Waypoints are noisy; the direction of an end is that of this many U of the piece.
END_SECTION = 1.0
# A vehicle that cannot rest is past an end where it is told to turn back, and to be slower than
# this part of its speed.
SLOWED = 0.5
# A flight that may be over before its time is looked at this often, s.
LOOK_PERIOD = 0.1
# What a flight tells of numba, whose code then lies in its cache on disk.
COMPILING = "compile, on the first run only"
# Points of each piece of the reference at which the demand of the path is read.
DEMAND_SAMPLES = 2_000
# The slider of the speed ends at what the vehicle can follow the path with, or at so many times
# the commanded speed.
TOP_SPEED = 5.0


@dataclass(frozen=True)
class FlightSpec:
    """How a vehicle is flown.

    Attributes:
        vehicle: A name of `systems.VEHICLES`.
        speed: Commanded speed, m/s; of a vehicle that only turns, its own.
        turn_radius: That of the tightest turn of such a vehicle, m; None: its own.
        laps: Lengths of every closed piece that are flown, at least 1, since the last lap is
            what is measured.
        altitude: Height of the flight where the field is planar, m.
        parameters: Those of a quadrotor; by default the paper's.
        sensors: Noise, delay and rates of the measurements; None: they are ideal.
        disturbance: Wind, drag, motor lag and what else is not as believed; None: nothing is.
        gains: Gains of a quadrotor's controller; with a disturbance bandwidth it makes up for
            that.
        heading: Where a quadrotor looks: "path", along its path, or the point (x, y) in m
            towards which it looks; None: where the gains say.
        jerk_feedforward: Whether a quadrotor is told how the command changes; see
            `systems.AddGuidance`.
        seed: Seed of the noise of the sensors and of the gusts.
        start: Position p_WB (x, y, z) of the hover that the flight starts from, m; None:
            beside the path, see `hover_start`.
        duration: Time of the flight, longer than the take-off, s; None: enough for the path.

    Raises:
        ConfigurationError: If a value cannot be used, or if the vehicle has no such thing.
    """

    speed: float = DEFAULT_SPEED
    laps: float = 2.0
    altitude: float = DEFAULT_ALTITUDE
    parameters: QuadrotorParameters = field(default_factory=QuadrotorParameters)
    sensors: SensorParameters | None = None
    disturbance: Disturbance | None = None
    gains: Gains = DEFAULT_GAINS
    heading: Literal["path"] | tuple[float, float] | None = None
    jerk_feedforward: bool = False
    seed: int = 0
    start: tuple[float, ...] | None = None
    duration: float | None = None
    vehicle: str = Quadrotor.name
    turn_radius: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("speed", self.speed), ("altitude", self.altitude)):
            if not (np.isfinite(value) and value > 0):
                raise ConfigurationError(f"the {name} must be a positive number, not {value}")
        if not (np.isfinite(self.laps) and self.laps >= 1):
            raise ConfigurationError(f"the number of laps must be at least 1, not {self.laps}")
        if self.duration is not None and not TAKE_OFF_S < self.duration < np.inf:
            raise ConfigurationError(
                f"the duration must be longer than {TAKE_OFF_S:g} s, the time for the "
                f"take-off, not {self.duration}"
            )
        _ = self.craft

    @property
    def craft(self) -> Vehicle:
        """What flies."""
        kind = VehicleNamed(self.vehicle)
        return kind.Make(self.speed, self.turn_radius, self.parameters, self.gains)

    def check_supervised(self) -> None:
        """Raises ConfigurationError unless the vehicle can be told to slow down and to stop."""
        if not self.craft.can_rest:
            raise ConfigurationError(
                f"tours and routes are for quadrotors: a {self.vehicle} can neither slow down "
                "nor stop"
            )

    def along(self, field: GuidingField, reference: ReferencePath, piece: int) -> "FlightSpec":
        """Returns the spec with a start beside a piece and time to fly along it.

        The time is that for the laps of a closed piece, or to the end of an open one and to
        come to rest there.  What this spec sets already stays.
        """
        start, duration = self.start, self.duration
        if start is None:
            start = tuple(hover_start(field, reference, piece, self.altitude).tolist())
        if duration is None:
            length, unit = float(reference.lengths[piece]), field.cloud.unit_length
            if reference.closed[piece]:
                duration = TAKE_OFF_S + (self.laps * length + WAY_IN * unit) / self.speed
            else:
                way = length + (WAY_IN + REST_WINDOW) * unit
                duration = TAKE_OFF_S + way / self.speed + REST_S
        return replace(self, start=start, duration=duration)


def hover_start(
    field: GuidingField, reference: ReferencePath, piece: int, altitude: float
) -> FloatArray:
    """Returns a position (3,) beside a piece, from which all of it can be flown.

    On a closed piece it is beside the first point, away from the middle.  On an open one it
    is before the start, in line with the first part of the piece; where the field comes to
    rest at the first of its points, it starts at the last.

    Args:
        field: The field, in metres.
        reference: Holds the piece, in metres.
        piece: Its number.
        altitude: The third coordinate for a planar piece, m.
    """
    points = reference.pieces[piece].vertices
    unit, ends = field.cloud.unit_length, field.ends
    middle = points.mean(axis=0)
    if not reference.closed[piece]:
        if len(ends):
            first, last = (
                np.linalg.norm(ends - point, axis=1).min() for point in points[[0, -1]]
            )
            points = points[::-1] if first < last else points
        far = np.linalg.norm(points - points[0], axis=1) > END_SECTION * unit
        count = int(np.argmax(far)) if far.any() else len(points)
        middle = points[: max(count, 2)].mean(axis=0)
    outward = points[0] - middle
    outward /= max(float(np.linalg.norm(outward)), 1e-12)
    start = points[0] + START_OFFSET * unit * outward
    return start if len(start) == 3 else np.append(start, altitude)


def route_start(itinerary: Itinerary, altitude: float) -> tuple[FloatArray, FloatArray]:
    """Returns a position (3,) beside the start of an itinerary, and the heading (d,) there.

    It is on that side where the network is farthest, for what is nearest is entered; of sides
    as good it is the one farthest back.

    Args:
        itinerary: In metres.
        altitude: The third coordinate in the plane, m.
    """
    network = itinerary.network
    first, ahead = itinerary.line.at(np.array([0.0, network.sigma]))
    heading = (ahead - first) / np.linalg.norm(ahead - first)
    angles = 2 * np.pi / START_SIDES * np.arange(START_SIDES)
    sides = np.zeros((START_SIDES, network.dim))
    sides[:, 0], sides[:, 1] = np.cos(angles), np.sin(angles)
    places = first + START_OFFSET * network.unit_length * sides
    apart = network.path.project(places).distance / network.unit_length
    start = places[np.argmax(apart - AS_GOOD * sides @ heading)]
    return start if len(start) == 3 else np.append(start, altitude), heading


def flown_pieces(field: GuidingField, reference: ReferencePath) -> list[int]:
    """Returns the pieces long enough to fly: all but stray points, shorter than one U.

    Raises:
        ConfigurationError: If there is none.
    """
    pieces = np.flatnonzero(reference.lengths >= field.cloud.unit_length).tolist()
    if not pieces:
        raise ConfigurationError(
            f"nothing to fly: the reference is only {reference.longest:g} m long, "
            f"the waypoints span {2 * field.cloud.half_extent:g} m"
        )
    return pieces


def check_feasibility(
    field: GuidingField,
    reference: ReferencePath,
    speed: float,
    vehicle: QuadrotorParameters | Vehicle,
    disturbance: Disturbance | None = None,
) -> Feasibility:
    """Compares what the path demands of a vehicle with what it can give.

    The demand is that of the field as it is flown; see `systems.FieldForSpeed`.

    Raises:
        ConfigurationError: If the vehicle cannot follow the path at all.
    """
    if not isinstance(vehicle, Vehicle):
        vehicle = Quadrotor(vehicle)
    points = [piece.sample(DEMAND_SAMPLES) for piece in reference.pieces]
    return vehicle.CheckFeasibility(field, points, speed, disturbance)


def check_branches(
    field: GuidingField | DirectedField,
    branches: Sequence[Branch],
    speed: float,
    parameters: QuadrotorParameters,
) -> Feasibility:
    """Compares the acceleration that branches demand with what the thrust allows.

    On a network that includes the turns of the heading at its nodes.
    """
    demands = [
        np.linalg.norm(branch.MotionAt(field, speed).acceleration, axis=1).max()
        for branch in branches
    ]
    return Feasibility(float(max(demands)), parameters.max_horizontal_acceleration)


class SimulatedFlight(NamedTuple):
    """What a simulation of a flight gives.

    Attributes:
        log: One row a sample of 10 ms: as `flight_log` returns it, and the cross-track error
            from the reference (m).
        wall_s: Wall time of the simulation, s.
        is_over: Whether the flight was over before its time.
        exit: Where and when the vehicle left the sublevel set that it was to stay in, which
            ended the flight; None: it did not, or there was none.
        feasibility: The demand of the path at the commanded speed.
        live: What was changed by sliders while it was simulated, and how it ended, by the names
            of `summary.json`; None: it was not live.  The log of a live flight has a column
            `live_...` more for each slider.
    """

    log: pd.DataFrame
    wall_s: float
    is_over: bool
    exit: SublevelExit | None
    feasibility: Feasibility
    live: dict[str, Any] | None = None


def simulate(
    field: GuidingField | DirectedField,
    reference: ReferencePath,
    spec: FlightSpec,
    piece: int,
    *,
    supervisor: Any = None,
    heading: FloatArray | None = None,
    feasibility: Feasibility | None = None,
    page: str | None = None,
    is_over: Callable[[Context], bool] | None = None,
    rest: float = 0.0,
    lyapunov: LyapunovFunction | None = None,
    level: float = np.inf,
    scene: FlightScene | None = None,
    diagram: Diagram | None = None,
    progress: Progress = no_progress,
) -> SimulatedFlight:
    """Flies from a start beside a piece of a path until the duration of a spec has passed.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flight is measured against, in metres.
        spec: The flight; its start and duration are those of `FlightSpec.along` where open.
        piece: Number of the piece.
        supervisor: Stands between guidance and controller, for a tour; None: there is none.
        heading: That of a directed field at the start, (d,).
        feasibility: The demand of the path; None: it is worked out from the reference.
        page: The name of the page of a scene; None: that of the piece, or of the tour.
        is_over: Tells from the root Context whether the flight is over before its duration
            has passed; asked every 0.1 s.  None: it never is.
        rest: Time for which a flight that is over flies on, s.
        lyapunov: V, in metres, which is logged; None: there is none.
        level: The flight ends when the vehicle leaves {V <= level}, once it has been inside.
        scene: Shows the flight, and records it in a page; None: nothing does.
        diagram: That of other flights by `flight_diagram`, of the same structure; None: it is
            built for this one.
        progress: Is told how far the simulation is.

    Raises:
        ConfigurationError: If the field is neither planar nor spatial.
        LostControlError: If the vehicle lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    craft = spec.craft
    craft.CheckGuided(field.dim, spec.speed)
    if not isinstance(field, DirectedField):
        spec = spec.along(field, reference, piece)
        if feasibility is None:
            feasibility = check_feasibility(
                field, reference, spec.speed, craft, spec.disturbance
            )
    assert spec.start is not None
    assert spec.duration is not None
    assert feasibility is not None
    built = diagram or flight_diagram(
        field,
        spec,
        supervisor=supervisor,
        lyapunov=lyapunov,
        level=level,
        meshcat=None if scene is None else scene.meshcat,
    )
    simulator = MakeSimulator(built)
    context = simulator.get_mutable_context()
    if diagram is not None:
        _set_parameters(built, context, spec)
    start = craft.StartState(np.array(spec.start), field, spec.disturbance)
    SetVehicleState(built, context, start)
    loop: Any = built.GetSubsystemByName("guidance_loop")
    if is_over is None and not craft.can_rest and not reference.closed[piece]:
        is_over = partial(_is_past_end, loop, craft.velocity, spec.speed)
    if heading is not None:
        guidance = loop.guidance
        guidance.SetHeading(guidance.GetMyMutableContextFromRoot(context), heading)
    SetNoiseSeed(built, context, spec.seed)
    watch = None if lyapunov is None else StopOnExit(simulator)
    live: dict[str, Any] = {}
    over, where, shown = False, f"piece {piece + 1}", f"flight_{piece + 1}"
    if supervisor is not None:
        where, shown = "the tour", "tour"
    log_so_far = partial(_measured_log, built, context, craft, reference)
    with (
        _lost_control_named(where, spec, feasibility, log_so_far),
        nullcontext()
        if scene is None
        else scene.show(
            simulator, page or shown, _top_speed(spec.speed, feasibility)
        ) as controls,
    ):
        _compile(loop, context, progress)
        begin = time.perf_counter()
        if controls is not None:
            over, live = _advance_live(
                simulator, controls, is_over, rest, spec.duration, progress
            )
        elif is_over is None:
            advance(simulator, spec.duration, LOG_PERIOD, "fly", progress)
        else:
            over = _advance_until(simulator, is_over, rest, spec.duration, progress)
        wall_s = time.perf_counter() - begin
    log = log_so_far()
    if controls is not None:
        log = _live_log(log, controls, lost=live["lost_control"] is not None)
    left = None if watch is None else watch.exit
    return SimulatedFlight(log, wall_s, over, left, feasibility, live or None)


def _compile(loop: Any, context: Context, progress: Progress) -> None:
    """Evaluates a loop once, so that numba compiles before the clock of a flight runs."""
    told = []

    def tell() -> None:
        told.append(COMPILING)
        progress(COMPILING, 0.0, 1.0)

    with announced(tell):
        loop.GetOutputPort(loop.actuation).Eval(loop.GetMyContextFromRoot(context))
    if told:
        progress(COMPILING, 1.0, 1.0)


def _measured_log(
    diagram: Diagram, context: Context, craft: Vehicle, reference: ReferencePath
) -> pd.DataFrame:
    """Returns the log with the error, as far as the positions are finite."""
    log = flight_log(diagram, context, craft)
    log = log.iloc[np.flatnonzero(np.isfinite(positions_of(log, 3)).all(axis=1))].copy()
    log["cross_track_error"] = reference.project(positions_of(log, reference.dim)).distance
    return log


def flight_diagram(
    field: GuidingField | DirectedField, spec: FlightSpec, **options: Any
) -> Diagram:
    """Returns the diagram of a flight, and of all others of the same structure.

    Drake has memory to give back for each diagram that was built from Python, and does not.
    So many flights share one: they may differ in all that `Disturbance.structure` and
    `SensorParameters.structure` have in common, and in seed, start and duration.

    Args:
        field: The field, in metres; planar or spatial.
        spec: The flight.
        **options: Further ones of `systems.MakeFlightDiagram`.
    """
    return MakeFlightDiagram(
        field,
        spec.craft,
        speed=spec.speed,
        altitude=spec.altitude,
        log_period=LOG_PERIOD,
        sensors=spec.sensors,
        disturbance=spec.disturbance,
        heading=None if spec.heading is None else _heading_system(spec.heading),
        jerk_feedforward=spec.jerk_feedforward,
        **options,
    )


def _set_parameters(diagram: Diagram, context: Context, spec: FlightSpec) -> None:
    """Sets what one flight has of its own in the Context of a diagram that many share."""
    plant: Any = diagram.GetSubsystemByName("plant")
    loop: Any = diagram.GetSubsystemByName("guidance_loop")
    if spec.disturbance is not None:
        plant.SetDisturbance(context, spec.disturbance)
    if spec.sensors is not None:
        capture = loop.motion_capture
        capture.SetNoise(capture.GetMyMutableContextFromRoot(context), spec.sensors)


def _heading_system(heading: Literal["path"] | tuple[float, float]) -> Any:
    return HeadingSystem(None if heading == "path" else heading)


@contextmanager
def _lost_control_named(
    where: str, spec: FlightSpec, feasibility: Feasibility, log: Callable[[], pd.DataFrame]
) -> Iterator[None]:
    """Makes one clear error, with its log, of a flight that loses control of the vehicle."""
    try:
        yield
    except (RuntimeError, NonFiniteValueError) as error:
        # How Drake's plant shows that it is out of control: a pitch of 90 degrees.  A disturbed
        # one may also be thrown about until its numbers overflow.
        disturbed = spec.disturbance is not None
        overflowed = disturbed and isinstance(error, NonFiniteValueError)
        if feasibility.is_feasible and not overflowed and "gimbal-lock" not in str(error):
            raise
        lost = LostControlError(
            f"the quadrotor lost control on {where} at {spec.speed:g} m/s, where "
            f"the path demands {feasibility.demand:.1f} m/s^2 and the thrust allows "
            f"{feasibility.limit:.1f} m/s^2; choose a lower speed"
            + (" or a weaker disturbance" if disturbed else "")
        )
        lost.log = log()
        raise lost from error


def _top_speed(speed: float, feasibility: Feasibility) -> float:
    """Returns the speed up to which a vehicle can follow a path, but not too many times more.

    What the path demands grows as the square of the speed, or less.
    """
    ratio = feasibility.limit / max(feasibility.demand, 1e-9)
    return speed * min(TOP_SPEED, max(1.0, float(np.sqrt(ratio))))


def _is_past_end(loop: Any, velocity: slice, speed: float, context: Context) -> bool:
    """Tells from the root Context whether a vehicle has just passed an end of its path."""
    own = loop.GetMyContextFromRoot(context)
    command = loop.GetOutputPort("velocity_command").Eval(own)[:2]
    ahead = loop.GetOutputPort("measured_state").Eval(own)[velocity][:2]
    return bool(np.hypot(*command) < SLOWED * speed and command @ ahead < 0)


def _advance_until(
    simulator: Simulator,
    is_over: Callable[[Context], bool],
    rest: float,
    duration: float,
    progress: Progress,
) -> bool:
    """Advances until a flight is over, and rests; returns whether it was within its time."""
    for look in range(1, int(np.ceil(duration / LOOK_PERIOD)) + 1):
        now = look * LOOK_PERIOD
        simulator.AdvanceTo(now)
        progress("fly", now, duration)
        if is_over(simulator.get_context()):
            simulator.AdvanceTo(now + rest)
            return True
    return False


def _advance_live(
    simulator: Simulator,
    controls: LiveControls,
    is_over: Callable[[Context], bool] | None,
    rest: float,
    duration: float,
    progress: Progress,
) -> tuple[bool, dict[str, Any]]:
    """Advances a flight that can be changed; returns whether it was over, and what was changed.

    It is changed and stopped after the take-off at the earliest, so that there is something to
    measure.  A change with which the vehicle loses control ends it too.
    """
    context = simulator.get_mutable_context()
    over, stopped, lost, look, end = False, False, None, 0, duration
    try:
        while not stopped and look * LOOK_PERIOD < end:
            if context.get_time() >= TAKE_OFF_S:
                controls.Apply(context)
            look += 1
            simulator.AdvanceTo(look * LOOK_PERIOD)
            progress("fly", context.get_time(), max(duration, context.get_time()))
            if is_over is not None and not over and is_over(context):
                over, end = True, context.get_time() + rest
            stopped = controls.stopped and context.get_time() > TAKE_OFF_S
    except (RuntimeError, NonFiniteValueError) as error:
        if not controls.changes:
            raise
        lost = f"t = {context.get_time():.1f} s: {error}"
    changes = [change._asdict() for change in controls.changes]
    return over, {"changes": changes, "stopped": stopped, "lost_control": lost}


def _live_log(log: pd.DataFrame, controls: LiveControls, lost: bool) -> pd.DataFrame:
    """Returns a log with what was set at each sample; it ends where control was lost."""
    columns = controls.Columns(log["time"].to_numpy())
    log = log.assign(**{f"live_{name}": values for name, values in columns.items()})
    if lost:
        upright = (log[["roll", "pitch"]].abs() < np.pi / 2).all(axis=1)
        log = log[np.logical_and.accumulate(upright)]
    return log


def flight_log(
    diagram: Diagram, context: Context, vehicle: Vehicle | None = None
) -> pd.DataFrame:
    """Returns what the logs of a flight diagram hold, as one table of one row a sample.

    Its columns are the time (s), the state (x ... yaw_rate, SI), the velocity command (m/s)
    and the propeller forces (N), or state and actuation of another vehicle; with a supervisor
    its mode and branch, and with a directed field the edge in use and the arc length on the
    itinerary (m); and with a Lyapunov function V and V_dot (1/s).

    Args:
        diagram: From `systems.MakeFlightDiagram`, with logs.
        context: The Context of the diagram.
        vehicle: What flew; None: a quadrotor.
    """
    flown = vehicle or Quadrotor()
    times, _ = read_log(diagram, context, "state_log")
    tables = [pd.DataFrame({"time": times})]
    for name, columns in (
        ("state", flown.state_columns),
        ("velocity_command", COMMAND_COLUMNS),
        (flown.actuation, flown.actuation_columns),
        ("mode", ("mode",)),
        ("branch", ("branch",)),
        ("edge", ("edge",)),
        ("arc", ("arc",)),
        ("V", ("V",)),
        ("V_dot", ("V_dot",)),
    ):
        if diagram.HasSubsystemNamed(f"{name}_log"):
            _, values = read_log(diagram, context, f"{name}_log")
            tables.append(pd.DataFrame(values, columns=list(columns)))
    log = pd.concat(tables, axis=1)
    return log.astype({name: int for name in ("mode", "branch", "edge") if name in log})


def positions_of(log: pd.DataFrame, dim: int) -> FloatArray:
    """Returns the first coordinates of p_WB, (T, dim) in m."""
    return log[list(POSITION_COLUMNS[:dim])].to_numpy()


def velocities_of(log: pd.DataFrame, dim: int = 3) -> FloatArray:
    """Returns the first coordinates of v_WB, (T, dim) in m/s."""
    return log[list(VELOCITY_COLUMNS[:dim])].to_numpy()
