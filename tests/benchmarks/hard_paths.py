"""From where on the network of a hard cloud is not found, and whether that is then said.

python -m tests.benchmarks.hard_paths --seeds 5

Lengths are in U, an eighth of the extent.  The noise is 0.05 U, unless it says otherwise.
"""

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
import pandas as pd

from tests.benchmarks.paths import VERDICTS, judge
from tests.networks import LOOP, SHAPES, STRAND, Shape, Topology

Cloud = tuple[NDArray[np.float64], tuple[Topology, ...]]
NOISE = 0.05
COUNT = 500
CIRCLE = SHAPES["circle"].strands[0] / 4


def strays(name: str, percent: float, seed: int) -> Cloud:
    """A shape, and waypoints anywhere in its box, in percent of its own."""
    points = SHAPES[name].sample(COUNT, NOISE, False, seed)
    box, size = (points.min(axis=0), points.max(axis=0)), (round(percent * COUNT / 100), 2)
    others = np.random.default_rng(seed).uniform(*box, size)
    return np.concatenate([points, others]), SHAPES[name].topologies


def gap(random: bool, spacings: float, seed: int) -> Cloud:
    """A circle with a gap: up to 2 spacings it is closed, from 16 on open, or else either."""
    points = SHAPES["circle"].sample(COUNT, NOISE, random, seed)
    angle = np.arctan2(points[:, 1], points[:, 0])
    # Of even waypoints, as many are missing as the gap has spacings, less one.
    kept = np.abs(angle) > (spacings - (not random)) * np.pi / COUNT
    right = ((LOOP,), (LOOP, STRAND), (STRAND,))
    return points[kept], right[(spacings > 2) + (spacings >= 16)]


def two_strands(random: bool, noises: float, seed: int) -> Cloud:
    """Two circles side by side, as many noises from each other."""
    radius = 2.0 - noises * NOISE / 4
    shape = Shape([radius * CIRCLE + [x, 0] for x in (-2, 2)], (Topology(2, 2),))
    return shape.sample(COUNT, NOISE, random, seed), shape.topologies


def bundle(closed: bool, ratio: float, seed: int) -> Cloud:
    """A path whose waypoints scatter more and more, from the noise to `ratio` times as much."""
    rng = np.random.default_rng(seed)
    u = 2 * np.pi * rng.uniform(0, 1, 2 * COUNT)
    wide = 0.5 - 0.5 * np.cos(u) if closed else u / (2 * np.pi)
    line = [4 * np.cos(u), 4 * np.sin(u)] if closed else [8 * u / (2 * np.pi), 1.5 * np.sin(u)]
    scatter = NOISE * ratio**wide * rng.normal(size=(2, 2 * COUNT))
    return (line + scatter).T, (LOOP if closed else STRAND,)


def spiral(random: bool, turns: float, seed: int) -> Cloud:
    """An Archimedean spiral, whose turns are 4 / turns apart."""
    angle = np.linspace(1, 2 * np.pi * turns, 4_000)[:, None]
    shape = Shape([angle * np.hstack([np.cos(angle), np.sin(angle)])], (STRAND,))
    return shape.sample(2 * COUNT, NOISE, random, seed), shape.topologies


def coverage(in_order: bool, noises: float, seed: int) -> Cloud:
    """Nine rows 1 apart, joined at their ends, and so many noises from each other."""
    rows = np.array([[x, y] for y in range(9) for x in ((0, 8) if y % 2 == 0 else (8, 0))])
    arc = np.append(0, np.cumsum(np.abs(np.diff(rows, axis=0)).sum(axis=1)))
    at = np.linspace(0, arc[-1], 2 * COUNT)
    rng = np.random.default_rng(seed)
    points = np.column_stack([np.interp(at, arc, x) for x in rows.T])
    points += rng.normal(0, 1 / noises, points.shape)
    return points if in_order else rng.permutation(points), (STRAND,)


CASES: dict[str, tuple[Callable[[float, int], Cloud], Sequence[float]]] = {
    **{
        f"{name}: strays, %": (partial(strays, name), (1, 3, 10))
        for name in ("circle", "star", "eight", "T", "roundabout")
    },
    "gap in even waypoints, spacings": (partial(gap, False), (2, 4, 8, 16)),
    "gap in random waypoints, mean spacings": (partial(gap, True), (2, 4, 8, 16)),
    "two strands, even: distance in noises": (partial(two_strands, False), (2, 4, 6, 8, 12)),
    "two strands, random: distance in noises": (partial(two_strands, True), (2, 4, 6, 8, 12)),
    "bundle, open: widest by narrowest": (partial(bundle, False), (2, 4, 8)),
    "bundle, closed: widest by narrowest": (partial(bundle, True), (2, 4, 8)),
    "spiral, even: turns": (partial(spiral, False), (2, 3, 4, 6, 8)),
    "spiral, random: turns": (partial(spiral, True), (2, 3, 4, 6, 8)),
    "coverage in order: rows in noises": (partial(coverage, True), (3, 4, 6, 8, 12)),
    "coverage, shuffled: rows in noises": (partial(coverage, False), (3, 4, 6, 8, 12)),
}


def find(case: tuple[str, float, int]) -> dict[str, Any]:
    """Finds the network of one cloud, and says whether it is the right one."""
    name, severity, seed = case
    points, right = CASES[name][0](severity, seed)
    return {"case": name, "severity": severity, "seed": seed, **judge(points, right)}


def main() -> None:
    """Prints the verdicts by case and severity."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    cases = [
        (name, severity, seed)
        for name, (_, severities) in CASES.items()
        for severity in severities
        for seed in range(options.seeds)
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        found = pd.DataFrame(pool.map(find, cases, chunksize=4))
    table = pd.crosstab([found["case"], found["severity"]], found["verdict"])
    print(table.reindex(columns=VERDICTS, fill_value=0).to_string())


if __name__ == "__main__":
    main()
