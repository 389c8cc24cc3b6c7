"""The flight: tracking error along both rings, over seeds and speeds.

Run by `make bench`; the table is printed and saved in build/bench.
"""

from collections.abc import Callable

import pandas as pd
import pytest

import sgvf_drake as sgvf
from sgvf_drake.experiments import choose_reference, fly

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
SEEDS = (0, 1, 2)


def train(seed: int) -> sgvf.GuidingField:
    cloud, _ = sgvf.make_shape("concentric-flight")
    return sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field


def test_tracking_error_of_both_rings(save: Save) -> None:
    rows = []
    for seed in SEEDS:
        field = train(seed)
        reference, _ = choose_reference(field)
        for speed in (0.45, 2.0):
            result = fly(field, reference, speed=speed)
            rows += [{"seed": seed, "speed": speed, **f.summary} for f in result.flights]
    table = pd.DataFrame(rows).drop(columns=["start_m", "speed_command_m_s"])
    save(table, "flight")
    slow, fast = table[table["speed"] == 0.45], table[table["speed"] == 2.0]
    assert slow["cross_track_rms_m"].max() <= 0.01
    assert slow["cross_track_max_m"].max() <= 0.03
    assert (slow["saturated_fraction_after_take_off"] == 0).all()
    assert fast["cross_track_rms_m"].max() <= 0.02
