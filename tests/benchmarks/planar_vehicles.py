"""How well vehicles that only turn follow paths, over turn radius, wind and speed, in tables.

python -m tests.benchmarks.planar_vehicles build/fields --courses Austin.csv
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.flight import check_feasibility, hover_start
from sgvf_drake.experiments.simulation import read_log
from sgvf_drake.fields import GuidingField, load_guiding_field
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.paths.reference import Piece, ReferencePath
from systems import (
    Disturbance,
    FixedWing,
    MakeFlightDiagram,
    MakeSimulator,
    SetNoiseSeed,
    SetVehicleState,
    Unicycle,
    Vehicle,
)
from systems.turning_vehicles import TurningVehicle

SPEED = 0.45
# Of a square of 6 m and a ring of 1 m.
HALF_SIDE, POINTS = 3.0, 60
# A course is scaled to this length for the robot, m.
COURSE_LENGTH = 60.0
# Widths of the flown field, in turn radii.
WIDTHS = (0.25, 0.5, 1.0, 2.0)
LAPS, LOG_PERIOD = 2.0, 0.05


def ring(count: int = POINTS) -> np.ndarray:
    """The waypoints of a ring of 1 m."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def square() -> np.ndarray:
    """The waypoints of a square."""
    along = np.linspace(-HALF_SIDE, HALF_SIDE, POINTS, endpoint=False)
    side = np.column_stack([along, np.full(POINTS, -HALF_SIDE)])
    turns = (np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
    return np.concatenate([side @ turn.T for turn in turns])


def field_of(name: str, points: np.ndarray, folder: Path) -> tuple[GuidingField, ReferencePath]:
    """A learned field, kept in a folder, and the closed line through its waypoints."""
    file = folder / f"{name}.safetensors"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        train(PointCloud(points), TrainingConfig()).field.save(file)
    corners = HALF_SIDE * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    line = {"ring": ring(720), "square": corners}.get(name, points)
    return load_guiding_field(file), ReferencePath((Piece(line, closed=True),))


def flown(
    learned: tuple[GuidingField, ReferencePath],
    vehicle: TurningVehicle,
    *,
    feedforward: bool = True,
    approach: float | None = None,
    air: Disturbance | None = None,
) -> str:
    """RMS and largest cross-track error of the last lap, in m; `approach` in turn radii.

    Without it, the field is as wide as the vehicle has it.
    """
    field, path = learned
    speed, length = vehicle.own_speed, path.longest
    diagram = MakeFlightDiagram(
        field,
        vehicle,
        speed=speed,
        disturbance=air,
        log_period=LOG_PERIOD,
        feedforward=feedforward,
    )
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    start = hover_start(field, path, 0, 0.0)
    SetVehicleState(diagram, context, vehicle.StartState(start, field, air))
    SetNoiseSeed(diagram, context, 1)
    if approach is not None:
        loop: Any = diagram.GetSubsystemByName("guidance_loop")
        own = loop.guidance.GetMyMutableContextFromRoot(context)
        width = max(field.approach_length, approach * vehicle.parameters.turn_radius)
        loop.guidance.SetApproachLength(own, width)
    slowest = speed - (np.hypot(*air.wind[:2]) if air else 0.0)
    simulator.AdvanceTo(min(LAPS * length / slowest, 2.0 * LAPS * length / speed))
    _, states = read_log(diagram, context, "state_log")
    lap = states[-int(length / speed / LOG_PERIOD) :]
    error = path.project(lap[:, :2]).distance
    return f"{np.sqrt((error**2).mean()):.3g} ({error.max():.3g})"


def feasible(learned: tuple[GuidingField, ReferencePath], vehicle: Vehicle) -> str:
    """The line on feasibility, or that the path is refused."""
    try:
        found = check_feasibility(*learned, vehicle.own_speed, vehicle)
    except ConfigurationError:
        return "refused"
    return f"{found.demand:.3g} of {found.limit:.3g}"


def over_turn_radius(learned: Any, radii: tuple[float, ...], speed: float, kind: Any) -> None:
    """Prints a row for each turn radius."""
    print("| turn radius [m] | curvature [1/m] | with feed-forward | without |")
    print("|---|---|---|---|")
    for radius in radii:
        vehicle = kind.Make(speed, radius)
        cells = [flown(learned, vehicle, feedforward=how) for how in (True, False)]
        print(
            f"| {radius:g} | {feasible(learned, vehicle)} | {' | '.join(cells)} |", flush=True
        )


def over_approach(learned: Any, radii: tuple[float, ...], speed: float) -> None:
    """Prints a row for each turn radius, a column for each width of the field."""
    print(f"| turn radius [m] | {' | '.join(f'{c:g} turn radii' for c in WIDTHS)} |")
    print("|---|---|---|---|---|")
    for radius in radii:
        vehicle = Unicycle.Make(speed, radius)
        cells = [flown(learned, vehicle, approach=width) for width in WIDTHS]
        print(f"| {radius:g} | {' | '.join(cells)} |", flush=True)


def over_wind(
    learned: Any, vehicle: TurningVehicle, airs: dict[str, Disturbance | None]
) -> None:
    """Prints a row for each wind."""
    print("| air | with feed-forward | without |\n|---|---|---|")
    for name, air in airs.items():
        cells = [flown(learned, vehicle, air=air, feedforward=how) for how in (True, False)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def over_lag(learned: Any, vehicle: Any, air: Disturbance | None) -> None:
    """Prints a row for each lag, a column for each width of the field."""
    print(f"| lag [s] | {' | '.join(f'{c:g} turn radii' for c in WIDTHS)} |")
    print("|---|---|---|---|---|")
    for lag in (0.0, 0.3, 0.6, 1.0):
        own = replace(vehicle, parameters=replace(vehicle.parameters, turn_lag=lag))
        cells = [flown(learned, own, approach=width, air=air) for width in WIDTHS]
        print(f"| {lag:g} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Prints all tables, of the error in m: RMS (largest)."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of the learned fields")
    parser.add_argument("--courses", type=Path, nargs="*", default=[], help="x,y in m, closed")
    parser.add_argument("--only", nargs="*", default=["ring", "square", "wing", "courses"])
    options = parser.parse_args()
    learned = {"ring": field_of("ring", ring(), options.folder)}
    if "ring" in options.only:
        print("# ring of 1 m, 0.45 m/s")
        over_turn_radius(learned["ring"], (0.9, 0.5, 0.25, 0.1), SPEED, Unicycle)
        over_approach(learned["ring"], (0.9, 0.5, 0.25), SPEED)
        winds = {
            f"{part:g} v": Disturbance((part * SPEED, 0.0, 0.0)) for part in (0.2, 0.4, 0.6)
        }
        over_wind(learned["ring"], FixedWing.Make(SPEED, 0.25), winds)
    if "square" in options.only:
        learned["square"] = field_of("square", square(), options.folder)
        print("# square of 6 m, 0.45 m/s")
        over_turn_radius(learned["square"], (1.0, 0.5, 0.25, 0.1), SPEED, Unicycle)
        over_approach(learned["square"], (1.0, 0.5, 0.25), SPEED)
    if "wing" in options.only:
        print("# ring of 100 m, 15 m/s, bank of 35 degrees")
        field, path = learned["ring"]
        wide, wing = (field.rescaled(100.0), path.rescaled(100.0)), FixedWing.Make(15.0)
        airs = {f"wind {w:g} m/s": Disturbance((w, 0.0, 0.0)) for w in (3.0, 6.0, 9.0)}
        gusty = Disturbance((6.0, 0.0, 0.0), gust=1.0)
        over_wind(wide, wing, {"still": None, **airs, "wind 6 m/s, gusts 1 m/s": gusty})
        for air in (None, airs["wind 9 m/s"]):
            over_lag(wide, wing, air)
    for file in options.courses if "courses" in options.only else ():
        points = np.loadtxt(file, delimiter=",")[:, :2]
        field, path = field_of(file.stem, points, options.folder)
        print(f"# {file.stem}, {path.longest:.0f} m")
        scale = COURSE_LENGTH / path.longest
        small = field.rescaled(scale), path.rescaled(scale)
        print(f"at a scale of {scale:.4g}, unicycle, 0.45 m/s")
        over_turn_radius(small, (0.25, 0.1, 0.05), SPEED, Unicycle)
        print("at full scale, fixed wing, 15 m/s")
        radii = (FixedWing.Make(15.0).parameters.turn_radius, 15.0)
        over_turn_radius((field, path), radii, 15.0, FixedWing)
        wind = {"wind 6 m/s": Disturbance((6.0, 0.0, 0.0))}
        over_wind((field, path), FixedWing.Make(15.0, radii[-1]), wind)


if __name__ == "__main__":
    main()
