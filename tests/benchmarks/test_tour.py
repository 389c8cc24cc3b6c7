"""Tours: learned fields of both scenarios, flown from piece to piece by noisy measurements.

Run by `make bench`; the table is printed and saved in build/bench, with a figure a scenario.
"""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

import sgvf_drake as sgvf
from sgvf_drake.experiments import choose_reference, fly_tour, tour_figure
from systems import FieldForSpeed, SensorParameters

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
SEEDS = (0, 1, 2)
SPEED = 0.45
TOURS = {"concentric-flight": (0, 1, 0), "separated-flight": (0, 1)}
# m, m/s
LARGEST_RMS, LEAST_SPEED = 0.015, 0.2


def parts_of(summary: dict) -> list[dict]:
    """The legs and the transfers of a tour, in the order of the flight."""
    parts = [{"part": "leg", **leg} for leg in summary["legs"]]
    parts += [{"part": "transfer", **transfer} for transfer in summary["transfers"]]
    return sorted(parts, key=lambda part: part["begin_s"])


@pytest.mark.parametrize("shape", TOURS)
def test_legs_and_transfers(save: Save, shape: str) -> None:
    tour = TOURS[shape]
    cloud, _ = sgvf.make_shape(shape)
    rows, summaries = [], []
    for seed in SEEDS:
        field = sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field
        reference, _ = choose_reference(field)
        result = fly_tour(
            field, reference, tour, speed=SPEED, sensors=SensorParameters(), seed=seed
        )
        summaries.append(result.summary())
        rows += [{"shape": shape, "seed": seed, **part} for part in parts_of(summaries[-1])]
        if seed == SEEDS[0]:
            figure = tour_figure(FieldForSpeed(field, SPEED), cloud, result)
            folder = Path("build/bench")
            folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(folder / f"tour_{shape}.png")
    table = pd.DataFrame(rows)
    save(table, f"tour_{shape}")
    for summary in summaries:
        assert summary["completed"]
        assert tuple(leg["piece"] for leg in summary["legs"]) == tour
        assert summary["cross_track_rms_m"] <= LARGEST_RMS
        assert summary["speed_min_m_s"] >= LEAST_SPEED
        assert summary["motor_force_min_n"] > 0.0
        assert summary["motor_force_max_n"] < summary["motor_force_limit_n"]
