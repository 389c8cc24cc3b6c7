"""How well the paths of clouds are followed that cross and branch, in tables over shapes.

python -m tests.benchmarks.networks courses angles --courses Suzuka.csv
"""

import argparse
from collections.abc import Callable, Iterator
import itertools
from pathlib import Path
import time
from typing import Any

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.follow import FollowResult, follow, follow_network
from sgvf_drake.experiments.route import covering_routes, fly_route
from sgvf_drake.fields import DirectedField, GuidingField
from sgvf_drake.learning import TrainingConfig, TrainingResult, train
from sgvf_drake.paths.itinerary import successors
from sgvf_drake.paths.planning import covering
from systems import SensorParameters
from tests.benchmarks.measuring import printed
from tests.networks import SHAPES, Array, Shape, recorded_motions, recorded_passes, topology

Row = dict[str, Any]

RECIPES = ("exact", "robust")
# Waypoints of a cloud and their noise in U.
POINTS, NOISE = 600, 0.02
# Agents that go straight on, headed by chance, and those on a route over every edge.
STARTS, ROUTE_STARTS = 100, 25
FRACTIONS = ("reach", "lap", "end", "stall", "leave", "straight", "turn")
# What is told of those on a route, where there is one.
LED = ("turn", "stall", "leave", "rms_U", "max_U")
# Networks are flown so wide, in m; and what is told of a flight.
WIDE = 12.0
FLOWN = ("route_length_m", "route_completed", "turned_nodes", "turn_fraction", "speed_min_m_s")
# Derivatives are taken at so many places, within this many noise levels of the paths; and so
# many values are timed.
PLACES, BAND, VALUES = 4_000, 3.0, 300
SLOPES = ["rms_U", "m_min", "m_max", "dm_dx", "dm_dg", "value_us", "cpu_s"]


def _lines(*ends: tuple[float, ...]) -> Shape:
    """Straight strands in the plane; each is x and y of its start and its end."""
    return Shape([np.linspace(e[:2], e[2:], 1_000) for e in ends], ())


COURSES = ("eight", "rose of three", "rose of four", "trefoil", "trefoil in space")
NETWORKS: dict[str, Shape] = {
    "streets": _lines(
        *((0, 0, 8, 0), (0, 4, 10, 4), (0, 8, 8, 8)),
        *((0, 0, 0, 8), (4, 0, 4, 8), (8, 0, 8, 8), (4, 4, 8, 8)),
    ),
    "letter": _lines((-2, -4, 0, 4), (0, 4, 2, -4), (-1, 0, 1, 0)),
    **{name: SHAPES[name] for name in ("T", "Y", "grid", "roundabout", "Y in space")},
}
ANGLES = (90, 75, 60, 45, 30, 20, 10)
TURN = np.radians(33)
TRANSFORMS: dict[str, Array] = {
    "as it is": np.eye(2),
    "stretched 1:2": np.diag([1, 0.5]),
    "stretched 1:4": np.diag([1, 0.25]),
    "times 1e-3": 1e-3 * np.eye(2),
    "times 1e4": 1e4 * np.eye(2),
    # And moved by a thousand times its extent.
    "turned, far": np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]),
}


def crossing(kind: str, degrees: float) -> Shape:
    """Two straight lines, or the lobes of an eight, that cross at an angle."""
    half = np.radians(degrees / 2)
    if kind == "lines":
        x, y = 4 * np.cos(half), 4 * np.sin(half)
        lines = _lines((-x, -y, x, y), (-x, y, x, -y))
        return Shape(lines.strands, SHAPES["X"].topologies)
    t = np.linspace(0, 2 * np.pi, 4_001)
    eight = 4 * np.column_stack([np.sin(t), np.tan(half) * np.sin(t) * np.cos(t)])
    return Shape([eight], SHAPES["eight"].topologies)


def sampled(shape: Shape, seed: int = 0) -> PointCloud:
    """Waypoints of a shape, shuffled."""
    return PointCloud(shape.sample(POINTS, NOISE, random=False, seed=seed))


def cloud_of(name: str) -> PointCloud:
    """The waypoints of a named shape, or those of a file."""
    if name in SHAPES or name in NETWORKS:
        return sampled((SHAPES | NETWORKS)[name])
    return PointCloud.read(name)


def trained_and_followed(cloud: PointCloud, **options: Any) -> tuple[TrainingResult, Row]:
    """Trains a field and follows it: straight on, and on networks over every edge besides."""
    result = train(cloud, TrainingConfig(**options))
    field, found = result.field, result.network
    row: Row = {"is": found.describe(0), "unsure": bool(found.unsure)}
    if isinstance(field, DirectedField):
        row |= figures(follow_network(field, STARTS), field)
        if not field.is_one_way:
            turns = sum(len(after) or 1 for after in successors(found).values())
            faults = [fault for piece in result.self_check.pieces for fault in piece.faults]
            row |= {"turns": turns, "made": turns - sum(f.kind == "skip" for f in faults)}
            row |= {"rest_free": row["stall"], "rms_free_U": row["rms_U"]}
            led = figures(follow_network(field, ROUTE_STARTS, route=covering(found)), field)
            row |= {name: led[name] for name in LED}
    else:
        row |= figures(follow(field, found.path, STARTS), field)
    check = "" if result.self_check.passed else result.self_check.message
    return result, {**row, "restarts": result.restarts, "cpu_s": result.cpu_s, "faults": check}


def figures(run: FollowResult[Any], field: DirectedField | GuidingField) -> Row:
    """What agents did; errors in U."""
    summary = run.summary()
    row = {name: summary.get(f"{name}_fraction") for name in FRACTIONS}
    for name in ("rms", "max"):
        error = summary[f"cross_track_{name}"]
        row[f"{name}_U"] = np.nan if error is None else error / field.cloud.unit_length
    return {**row, "m_min": run.speed_on_path[0], "m_max": run.speed_on_path[1]}


def slopes(field: DirectedField | GuidingField) -> Row:
    """The largest derivatives in a band around the paths, and what one value costs."""
    rng = np.random.default_rng(0)
    unit = field.cloud.unit_length
    x = np.concatenate([piece.sample(PLACES) for piece in field.network.path.pieces])
    x = rng.permutation(x)[:PLACES]
    away, g = rng.normal(size=(2, *x.shape))
    away, g = (u / np.linalg.norm(u, axis=1, keepdims=True) for u in (away, g))
    x += BAND * field.sigma * unit * rng.uniform(size=(len(x), 1)) * away
    inputs = (x, g) if isinstance(field, DirectedField) else (x,)
    J = {"dm_dx": unit * field.value_and_jacobian(*inputs)[1]}
    if isinstance(field, DirectedField):
        J["dm_dg"] = field.jacobian_by_direction(x, g)
    row: Row = {
        name: np.linalg.norm(values, 2, axis=(1, 2)).max() for name, values in J.items()
    }
    begin = time.process_time()
    for k in range(VALUES):
        field(*(values[k] for values in inputs))
    return {**row, "value_us": 1e6 * (time.process_time() - begin) / VALUES}


def shape(name: str, recipe: str) -> Row:
    """A course or a network, by one recipe."""
    result, row = trained_and_followed(cloud_of(name), recipe=recipe)
    return {"shape": Path(name).stem, "recipe": recipe, **row, **slopes(result.field)}


def angle(kind: str, degrees: float, seed: int) -> Row:
    """Two strands that cross: what is found, and how it is followed."""
    true = crossing(kind, degrees)
    result, row = trained_and_followed(sampled(true, seed), recipe="exact", max_restarts=0)
    right = topology(result.network) in true.topologies
    return {"crossing": kind, "degrees": degrees, "seed": seed, "right": right, **row}


def flown(name: str, recipe: str) -> Row:
    """The quadrotor over every edge of a network, measured with noise and delay."""
    field = train(cloud_of(name), TrainingConfig(recipe=recipe)).field
    assert isinstance(field, DirectedField)
    metric = field.rescaled(WIDE / np.ptp(field.cloud.points, axis=0).max())
    route = max(covering_routes(metric.network), key=lambda route: route.length)
    flight = fly_route(metric, route, sensors=SensorParameters())
    unit, figures = metric.cloud.unit_length, flight.summary()
    errors = ("cross_track_rms_m", "cross_track_max_m", "turn_error_max_m")
    return {
        "shape": Path(name).stem,
        "recipe": recipe,
        "sigma_m": metric.memory_length,
        "unit_m": unit,
        **{key: figures[key] for key in FLOWN},
        **{
            f"{key[:-2]}_U": None if figures[key] is None else figures[key] / unit
            for key in errors
        },
    }


def transformed(name: str, transform: str) -> Row:
    """One cloud in another proportion, unit and place."""
    points = cloud_of(name).points
    away = 1e3 * np.ptp(points, axis=0).max() if transform == "turned, far" else 0.0
    cloud = PointCloud(points @ TRANSFORMS[transform].T + away)
    row = trained_and_followed(cloud, recipe="exact")[1]
    return {"cloud": Path(name).stem, "transform": transform, **row}


def demonstrations(name: str, recipe: str) -> Row:
    """All recordings of one motion of the LASA handwriting set, as passes of one path."""
    recorded = recorded_passes(name)
    cloud = PointCloud(np.concatenate(recorded))
    result, row = trained_and_followed(cloud, recipe=recipe, open=True, passes=True)
    ways = [np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in recorded]
    row["length"] = result.network.length / np.mean(ways)
    return {"motion": name, "recipe": recipe, **row}


def cases(table: str, options: argparse.Namespace) -> Iterator[tuple[Any, ...]]:
    """The arguments of each row of a table."""
    courses = (*COURSES, *options.courses)
    yield from {
        "courses": itertools.product(courses, RECIPES),
        "networks": itertools.product(NETWORKS, RECIPES),
        "angles": itertools.product(("lines", "eight"), ANGLES, range(options.seeds)),
        "flights": itertools.product(NETWORKS, RECIPES),
        "transformed": itertools.product(("eight", "streets"), TRANSFORMS),
        "demonstrations": itertools.product(recorded_motions(), options.recipes),
    }[table]


TABLES: dict[str, Callable[..., Row]] = {
    "courses": shape,
    "networks": shape,
    "angles": angle,
    "flights": flown,
    "transformed": transformed,
    "demonstrations": demonstrations,
}


def main() -> None:
    """Prints the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", help=", ".join(TABLES), default=list(TABLES))
    parser.add_argument("--courses", nargs="+", default=[], help="files of courses besides")
    parser.add_argument("--recipes", nargs="+", default=["exact"], help="of demonstrations")
    parser.add_argument("--seeds", type=int, default=3, help="clouds of each crossing")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chosen = {name: TABLES[name] for name in options.tables}
    for name, rows in printed(chosen, lambda name: cases(name, options), options.jobs):
        if name in ("courses", "networks"):
            beside = rows.pivot(index="shape", columns="recipe", values=SLOPES)
            print(f"\nlearned beside exact\n{beside.round(4).to_string()}", flush=True)


if __name__ == "__main__":
    main()
