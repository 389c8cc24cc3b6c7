"""What benchmarks measure by: fields trained anew, the best of several runs, a plain field."""

from concurrent.futures import ProcessPoolExecutor
import time

import numpy as np
import pandas as pd

import sgvf_drake as sgvf

SEEDS = (0, 1, 2)


def trained(shape, seed=0, recipe="robust", order=0):
    """What a recipe learns of a named shape, and its true path; `order` shuffles it."""
    cloud, path = sgvf.make_shape(shape, seed=order)
    return sgvf.train(cloud, sgvf.TrainingConfig(recipe=recipe, seed=seed)), path


def timed(call, clock=time.process_time):
    """What a call returns, and how many seconds it takes, by default of the process."""
    begin = clock()
    result = call()
    return result, clock() - begin


def best_of(call, repeats=3, clock=time.process_time):
    """The results of several calls, and the least time: others only make it longer."""
    results, seconds = zip(*(timed(call, clock) for _ in range(repeats)), strict=True)
    return results, min(seconds)


def printed(tables, cases, jobs):
    """Yields the names and the rows of tables, which are printed as they come.

    Args:
        tables: Names, and what makes a row of each.
        cases: Gives the arguments of each row of a table.
        jobs: The number of processes.
    """
    with ProcessPoolExecutor(jobs) as pool:
        for name, row in tables.items():
            waiting = [pool.submit(row, *case) for case in cases(name)]
            rows = pd.DataFrame([row.result() for row in waiting])
            print(f"\n{name}\n{rows.round(4).to_string(index=False)}", flush=True)
            yield name, rows


class Circle:
    """A field of length one around the unit circle that costs next to nothing.

    It runs counter-clockwise.  With the direction from the centre n, the tangent t and
    z = gain (1 - r), it is (z n + t) / sqrt(1 + z^2).
    """

    dim = 2

    def __init__(self, gain=2.0):
        self._gain = gain

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        r = np.hypot(*x)
        n = x / r
        t = np.array([-n[1], n[0]])
        z = self._gain * (1.0 - r)
        c = 1.0 / np.sqrt(1.0 + z * z)
        s = z * c
        return s * n + c * t, np.outer(s * t - c * n, self._gain * c * c * n + t / r)
