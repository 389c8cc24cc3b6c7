"""Certificates of trained fields in tables: what is proved, its cost, and robots beside it.

python -m tests.benchmarks.certificates shapes circuits --courses Austin.csv Spa.csv
"""

import argparse
from collections.abc import Callable, Iterator
import itertools
from pathlib import Path
import time
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import sgvf_drake as sgvf
from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate import Cells, Certificate, check, check_network, prove_basin
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments import as_flown
from sgvf_drake.fields import DirectedField, GuidingField
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.paths import make_shape
from sgvf_drake.paths.planning import covering
from tests.benchmarks.measuring import printed
from tests.benchmarks.networks import cloud_of
from tests.networks import recorded_motions, recorded_passes

Row = dict[str, Any]

SHAPES = (
    *("concentric-circles", "separated-circles", "concentric-flight", "separated-flight"),
    *("square", "hexagon", "octagon", "triangle", "star"),
)
# Of the paper's flights, in m/s.
FLIGHTS = (("concentric-flight", 0.45), ("separated-flight", 2.0))
RECORDINGS = 5
ROUTES = ("eight", "T", "Y", "Y in space")
# Robots that are simulated of each kind, and for how long, in lengths of the unit.
STARTS, DURATION = 400, 20.0


def space_curve(name: str) -> PointCloud:
    """A trefoil knot, a helix with two ends, and a circle that is tilted."""
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    curves = {
        "trefoil": [
            np.sin(t) + 2 * np.sin(2 * t),
            np.cos(t) - 2 * np.cos(2 * t),
            -np.sin(3 * t),
        ],
        "helix": [2 * np.cos(2 * t), 2 * np.sin(2 * t), t - np.pi],
        "tilted circle": [3 * np.cos(t), 2 * np.sin(t), 2 * np.sin(t)],
    }
    return PointCloud(np.random.default_rng(0).permutation(np.column_stack(curves[name])))


def lap_time(field: GuidingField, start: FloatArray, about: float) -> float:
    """The time in which a robot comes back once it has settled, by SciPy's LSODA."""

    def rate(_: float, x: FloatArray) -> FloatArray:
        return np.asarray(field(x[None])[0])

    precision: dict[str, Any] = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-11 * about}
    place = solve_ivp(rate, (0, 1.2 * about), start, **precision).y[:, -1]
    normal = rate(0.0, place)

    def passed(t: float, x: FloatArray) -> float:
        off = x - place
        near = t > 0.1 * about and off @ off < (0.02 * about) ** 2
        return float(off @ normal) if near else -1.0

    passed.terminal, passed.direction = True, 1.0  # type: ignore[attr-defined]
    step = 0.01 * about
    run = solve_ivp(rate, (0, 2 * about), place, events=passed, max_step=step, **precision)
    return float(run.t_events[0][0])


def proved(field: GuidingField) -> tuple[Certificate, Row]:
    """What is certified of a field, and a row of it."""
    unit, begin = field.cloud.unit_length, time.process_time()
    found = sgvf.certify(field)
    seconds, begin = time.process_time() - begin, time.process_time()
    again = check(found, field)
    row: Row = {
        "certified": found.certified and again.certified,
        "basin": found.area_fraction,
        "almost": found.almost_fraction,
        "excluded": len(found.excluded),
        "walls": [len(walls) for walls in found.walls if walls is not None],
        "e_star": found.e_star_max,
        "entry_U": None if found.entry_time_bound is None else found.entry_time_bound / unit,
        "unique": [piece.orbit_unique for piece in found.pieces],
        "tube_U": max(piece.tube_half_width or np.nan for piece in found.pieces) / unit,
        "off_path_U": (found.orbit_half_width or np.nan) / unit,
    }
    laps = []
    for piece, tube in zip(found.pieces, found.tubes, strict=True):
        if tube is None or not tube.closed or piece.lap_time_low is None:
            continue
        start = field.cloud.denormalize(tube.rows[0, 0])
        assert piece.lap_time_high is not None
        lap = lap_time(field, start, piece.lap_time_high)
        assert piece.lap_time_low <= lap <= piece.lap_time_high
        laps += [piece.lap_time_low / lap - 1, piece.lap_time_high / lap - 1]
    if laps:
        row |= {"lap_low_%": 100 * min(laps), "lap_high_%": 100 * max(laps)}
    check_s = time.process_time() - begin
    return found, {**row, "patches": found.boxes, "cpu_s": seconds, "check_s": check_s}


def field_of(cloud: PointCloud, **options: Any) -> GuidingField:
    """A field that was trained on a cloud, and its kernels compiled."""
    field = train(cloud, TrainingConfig(**options)).guiding_field
    sgvf.certify(field)
    return field


def shape(name: str, seed: int) -> Row:
    """A shape of the paper."""
    return {"shape": name, "seed": seed} | proved(field_of(make_shape(name)[0], seed=seed))[1]


def circuit(file: str) -> Row:
    """A race circuit from a file."""
    return {"circuit": Path(file).stem} | proved(field_of(PointCloud.read(file)))[1]


def flight(name: str, speed: float) -> Row:
    """A field as the quadrotor flies it at a speed."""
    flown = as_flown(field_of(make_shape(name)[0]), speed)
    return {"flight": name, "m/s": speed} | proved(flown)[1]


def handwriting(name: str) -> Row:
    """All recordings of one motion of the LASA handwriting set, as passes of one open path."""
    cloud = PointCloud(np.concatenate(recorded_passes(name)))
    return {"motion": name} | proved(field_of(cloud, open=True, passes=True))[1]


def in_space(name: str) -> Row:
    """A curve in space."""
    return {"curve": name} | proved(field_of(space_curve(name)))[1]


def route(name: str) -> Row:
    """All sections and turns of a network, by its name or from a file, and a covering route."""
    result = train(cloud_of(name), TrainingConfig(recipe="exact"))
    field = result.field
    assert isinstance(field, DirectedField)
    legs = covering(field.network)
    # Compiled first.
    sgvf.certify_network(field, legs)
    begin = time.process_time()
    whole = sgvf.certify_network(field)
    seconds = time.process_time() - begin
    along = sgvf.certify_network(field, legs)
    checked = check_network(whole, field).certified and check_network(along, field).certified
    low, high = along.route_time_low, along.route_time_high
    return {
        **{"network": Path(name).stem, "whole": whole.certified, "route": along.certified},
        "checked": checked,
        "sections": len(whole.sections),
        "because": whole.reason,
        "turns": len(whole.turns),
        "bounds_%": None if low is None or high is None else 100 * (high - low) / (high + low),
        **{"patches": whole.boxes, "cpu_s": seconds},
    }


def starts(name: str, seed: int) -> Row:
    """Robots from proved squares, from the walls, and from squares that are not proved."""
    field = field_of(make_shape(name)[0], seed=seed)
    found = sgvf.certify(field)
    walls = [one for one in found.walls if one is not None]
    assert found.cells is not None
    basin = prove_basin(field, Cells.of(found.cells), walls, found.fences)
    boxes, rng = basin.cells.boxes, np.random.default_rng(seed)

    def some(rows: BoolArray) -> FloatArray:
        """Points of squares, the more the larger the square."""
        area = boxes.half[rows] ** 2
        chosen = rng.choice(np.flatnonzero(rows), STARTS, p=area / area.sum())
        steps = rng.uniform(-1, 1, (STARTS, 2))
        return np.asarray(boxes.centers[chosen] + steps * boxes.half[chosen, None])

    def come(z: FloatArray, duration: float) -> float:
        """The part of robots that are between walls in the end."""
        ends = Boxes.points(after(field, z, duration))
        return float(np.mean(np.any([one.hold(ends)[0] for one in walls], axis=0)))

    corners = np.concatenate([one.polygons(side)[-1] for one in walls for side in (1, -1)])
    on_walls = corners[rng.choice(len(corners), STARTS)]
    assert found.entry_time_bound is not None
    entry = found.entry_time_bound / field.cloud.unit_length
    then = Boxes.points(after(field, on_walls, entry))
    innermost = np.any([one[:1].hold(then)[0] for one in walls], axis=0)
    return {
        **{"shape": name, "seed": seed},
        "proved": come(some(basin.comes), DURATION),
        "walls": float(innermost.mean()),
        "not proved": come(some(~basin.comes), DURATION),
    }


def after(field: GuidingField, z: FloatArray, duration: float) -> FloatArray:
    """Where robots are after a time, all in normalised units."""

    def rate(_: float, state: FloatArray) -> FloatArray:
        return np.asarray(field(field.cloud.denormalize(state.reshape(-1, 2)))).ravel()

    run = solve_ivp(rate, (0, duration), z.ravel(), rtol=1e-6, atol=1e-8)
    return np.asarray(run.y[:, -1].reshape(-1, 2))


TABLES: dict[str, Callable[..., Row]] = {
    "shapes": shape,
    "circuits": circuit,
    "flights": flight,
    "handwriting": handwriting,
    "space": in_space,
    "starts": starts,
    "routes": route,
}


def cases(table: str, options: argparse.Namespace) -> Iterator[tuple[Any, ...]]:
    """The arguments of each row of a table."""
    yield from {
        "shapes": itertools.product(SHAPES, range(options.seeds)),
        "circuits": ((course,) for course in options.courses),
        "flights": FLIGHTS,
        "handwriting": ((name,) for name in recorded_motions()[:RECORDINGS]),
        "space": (("trefoil",), ("helix",), ("tilted circle",)),
        "starts": itertools.product(SHAPES, range(1)),
        "routes": ((name,) for name in (*ROUTES, *options.networks)),
    }[table]


def main() -> None:
    """Prints the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", help=", ".join(TABLES), default=list(TABLES))
    parser.add_argument("--courses", nargs="+", default=[], help="files of circuits")
    parser.add_argument("--networks", nargs="+", default=[], help="files of networks")
    parser.add_argument("--seeds", type=int, default=3, help="fields of each shape")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    chosen = {name: TABLES[name] for name in options.tables}
    for _ in printed(chosen, lambda name: cases(name, options), options.jobs):
        pass


if __name__ == "__main__":
    main()
