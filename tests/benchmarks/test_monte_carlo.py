"""Monte Carlo of flights of 20 s in wind: here, in processes, on the workers of a Dask cluster.

`SGVF_FLIGHTS=1000` flies so many; it is fewer where that is not set.  The processes and the
cluster do it again while one of their workers is killed.
"""

import os
import signal
import time

import pandas as pd
import psutil
import pytest

from sgvf_drake.experiments import (
    Distributions,
    DisturbanceDistributions,
    MonteCarlo,
    run_monte_carlo,
    workers_of,
)
from tests.data.make import field_file

pytestmark = pytest.mark.benchmark

FLIGHTS = int(os.environ.get("SGVF_FLIGHTS", "60"))
WORKERS = 2
DURATION = 20.0
# Flights before the memory is looked at: what is loaded and compiled comes first.
WARM_UP = 10
MB = 1e6


class Watch:
    """Told of progress: measures the memory of this process and its own, and kills one."""

    def __init__(self, kills):
        self.kills, self.memory, self.victims = kills, [], []

    def __call__(self, stage, done, total):
        own = psutil.Process()
        flying = [
            child
            for child in own.children(recursive=True)
            if "spawn_main" in " ".join(child.cmdline())
        ]
        if done >= WARM_UP * WORKERS:
            self.memory.append(max(one.memory_info().rss for one in flying or [own]) / MB)
        if self.kills and not self.victims and done == total // 2:
            self.victims.append(flying[-1].pid)
            os.kill(self.victims[0], signal.SIGKILL)


def fly(out, kills, **options):
    """Flies all flights; returns the figures, and the rows."""
    distributions = Distributions(
        disturbance=DisturbanceDistributions(wind=[1.0, 0.0, 0.0], gust=0.3)
    )
    experiment = MonteCarlo(
        str(field_file("flight")), duration=DURATION, distributions=distributions
    )
    watch = Watch(kills)
    begin = time.perf_counter()
    summary = run_monte_carlo(experiment, out, flights=FLIGHTS, progress=watch, **options)
    wall_s = time.perf_counter() - begin
    assert len(watch.victims) == kills
    figures = {
        "flights": FLIGHTS,
        "killed": len(watch.victims),
        "wall_s": wall_s,
        "flights_per_s": FLIGHTS / wall_s,
        "success_fraction": summary["success_fraction"],
        "memory_first_mb": watch.memory[0],
        "memory_last_mb": watch.memory[-1],
    }
    return figures, pd.read_parquet(out / "flights.parquet")


def test_flights_in_wind_wherever_they_fly(save, tmp_path):
    from distributed import LocalCluster

    rows, tables = [], []

    def run(name, kills=0, **options):
        figures, table = fly(tmp_path / f"{name}{kills}", kills, **options)
        rows.append({"where": name, **figures})
        tables.append(table)

    run("here")
    for kills in (0, 1):
        run("processes", kills, jobs=WORKERS)
        with (
            LocalCluster(
                n_workers=WORKERS,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=":0",
            ) as cluster,
            workers_of(cluster.scheduler_address) as executor,
        ):
            run("dask", kills, executor=executor)
    for row in rows:
        speed_up = rows[0]["wall_s"] / row["wall_s"]
        row["efficiency"] = speed_up / (1 if row["where"] == "here" else WORKERS)
    save(rows, "monte_carlo")
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0], check_exact=True)
    # Of each flight that is flown in a diagram of its own there are 1.5 MB left.
    here = rows[0]
    assert here["memory_last_mb"] - here["memory_first_mb"] < 0.1 * FLIGHTS
