"""Certificates of trained fields: what is proved, what it costs, and laps beside their bounds.

Run by `make bench`; the tables are printed and saved in build/bench.
"""

import time

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import sgvf_drake as sgvf
from sgvf_drake.certificate import check

pytestmark = pytest.mark.benchmark

SEEDS = (0, 1, 2)
SHAPES = (
    *("concentric-circles", "separated-circles", "concentric-flight", "separated-flight"),
    *("square", "hexagon", "octagon", "triangle", "star"),
)


def lap_time(field, center, start):
    """The time of the second lap about a point, by SciPy; as of the field, in its own unit."""

    def rate(_, state):
        p, m = state[:2] - center, field(state[None, :2])[0]
        return np.array([*m, (p[0] * m[1] - p[1] * m[0]) / (p @ p)])

    def first(_, state):
        return float(abs(state[2]) - 2 * np.pi)

    def second(_, state):
        return float(abs(state[2]) - 4 * np.pi)

    second.terminal = True  # type: ignore[attr-defined]
    run = solve_ivp(
        rate,
        (0, 1e4),
        [*start, 0.0],
        method="LSODA",
        events=[first, second],
        rtol=1e-9,
        atol=1e-11,
    )
    return float(run.t_events[1][0] - run.t_events[0][0])


def laps_of(field, found):
    """What is proved of each piece, beside the lap that is simulated."""
    rows = []
    for piece, annulus in zip(found.pieces, found.annuli, strict=True):
        assert annulus is not None
        center, start = field.cloud.denormalize(np.array([annulus.center, annulus.vertices[0]]))
        low, high = piece.lap_time_low, piece.lap_time_high
        lap = lap_time(field, center, start)
        assert low is not None
        assert high is not None
        assert low <= lap <= high
        unique = piece.orbit_unique
        rows.append({"unique": unique, "low": low / lap - 1, "high": high / lap - 1})
    return rows


def test_certificates_of_trained_fields(save):
    rows, laps = [], []
    for shape in SHAPES:
        for seed in SEEDS:
            cloud, path = sgvf.make_shape(shape, seed=seed)
            field = sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field
            times = [time.process_time()]
            found = sgvf.certify(field, path)
            times.append(time.process_time())
            assert found.certified, (shape, seed, found.reason, found.counterexample)
            assert check(found, field, path).certified
            times.append(time.process_time())
            assert found.conditions is not None
            of = {"shape": shape, "seed": seed}
            names = ("sigma", "tube_half_width", "orbit_half_width", "entry_time_bound")
            lengths = {name: getattr(found, name) / cloud.unit_length for name in names}
            shares = ("area_fraction", "decrease_fraction", "e_star_max", "delta", "boxes")
            rows.append(
                of
                | {"c_in": found.conditions.c_in, "c_out": found.conditions.c_out}
                | lengths
                | {name: getattr(found, name) for name in shares}
                | {"search and proof, s": times[1] - times[0], "proof, s": times[2] - times[1]}
            )
            laps += [of | row for row in laps_of(field, found)]
    save(pd.DataFrame(rows), "certificates")
    save(pd.DataFrame(laps), "certificate_laps")
