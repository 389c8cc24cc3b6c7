"""How often the network of a cloud is found, over shapes, samplings, noises and seeds.

python -m tests.benchmarks.paths --counts 200 --seeds 5
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
import itertools
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
import pandas as pd

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.finding import find_paths
from tests.networks import SHAPES, Topology, topology

NOISES = (0.0, 0.02, 0.05)
COUNTS = (200, 500, 1000)
VERDICTS = ("right", "right but flagged", "wrong and flagged", "wrong and sure")


def find(case: tuple[str, str, int, float, int]) -> dict[str, Any]:
    """Finds the network of one cloud, and says whether it is the right one."""
    name, sampling, count, noise, seed = case
    points = SHAPES[name].sample(count, noise, sampling == "random", seed)
    return {
        "shape": name,
        "sampling": sampling,
        "points": count,
        "noise": noise,
        "seed": seed,
        **judge(points, SHAPES[name].topologies),
    }


def judge(points: NDArray[np.float64], topologies: Sequence[Topology]) -> dict[str, Any]:
    """Finds the network of points (n, d), and says whether it is one of the right ones."""
    begin = time.process_time()
    try:
        network = find_paths(PointCloud(points))
        right, flagged = topology(network) in topologies, network.unsure is not None
    except PointCloudError:
        right, flagged = False, True
    verdict = VERDICTS[flagged if right else 3 - flagged]
    return {"verdict": verdict, "cpu_s": time.process_time() - begin}


def cases(
    counts: list[int], samplings: list[str], seeds: range
) -> Iterator[tuple[str, str, int, float, int]]:
    """All clouds; without noise, an even one is the same for every seed."""
    for case in itertools.product(SHAPES, samplings, counts, NOISES, seeds):
        _, sampling, _, noise, seed = case
        if sampling == "random" or noise > 0 or seed == seeds[0]:
            yield case


def main() -> None:
    """Prints the verdicts by sampling and number of points, and every sure error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS)
    parser.add_argument("--samplings", nargs="+", default=["even", "random"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    with ProcessPoolExecutor(options.jobs) as pool:
        found = pd.DataFrame(
            pool.map(find, cases(options.counts, options.samplings, seeds), chunksize=4)
        )
    table = found.pivot_table(
        index=["sampling", "points"], columns="verdict", aggfunc="size", fill_value=0
    )
    table["clouds"] = table.sum(axis=1)
    table["CPU s"] = found.groupby(["sampling", "points"])["cpu_s"].mean().round(2)
    print(table.to_string())
    failed = found[found["verdict"].str.startswith("wrong")]
    print(failed.groupby(["verdict", "sampling", "points", "shape"]).size().to_string())


if __name__ == "__main__":
    main()
