"""Flights of learned fields over seeds: each ring at two speeds; tours with noisy sensors."""

import pytest

from sgvf_drake.experiments import choose_reference, fly, fly_tour, tour_figure
from systems import FieldForSpeed, SensorParameters

from .measuring import SEEDS, trained

pytestmark = pytest.mark.benchmark

SPEED = 0.45
TOURS = {"concentric-flight": (0, 1, 0), "separated-flight": (0, 1)}
# m, m/s
LARGEST_RMS, LEAST_SPEED = 0.015, 0.2


def trained_fields(shape):
    """The fields by seed, each with its reference."""
    for seed in SEEDS:
        field = trained(shape, seed)[0].field
        yield seed, field, choose_reference(field)[0]


def test_tracking_error_of_both_rings(save):
    table = save(
        [
            {"seed": seed, "speed": speed, **flight.summary}
            for seed, field, reference in trained_fields("concentric-flight")
            for speed in (SPEED, 2.0)
            for flight in fly(field, reference, speed=speed).flights
        ],
        "flight",
    )
    slow, fast = table[table["speed"] == SPEED], table[table["speed"] == 2.0]
    assert slow["cross_track_rms_m"].max() <= 0.01
    assert slow["cross_track_max_m"].max() <= 0.03
    assert (slow["saturated_fraction_after_take_off"] == 0).all()
    assert fast["cross_track_rms_m"].max() <= 0.02


@pytest.mark.parametrize("shape", TOURS)
def test_legs_and_transfers(save, out, shape):
    tour, rows = TOURS[shape], []
    for seed, field, reference in trained_fields(shape):
        options = {"speed": SPEED, "sensors": SensorParameters(), "seed": seed}
        result = fly_tour(field, reference, tour, **options)
        summary = result.summary()
        parts = [{"part": "leg", **leg} for leg in summary["legs"]]
        parts += [{"part": "transfer", **transfer} for transfer in summary["transfers"]]
        parts.sort(key=lambda part: part["begin_s"])
        rows += [{"shape": shape, "seed": seed, **part} for part in parts]
        if seed == SEEDS[0]:
            figure = tour_figure(FieldForSpeed(field, SPEED), field.cloud, result)
            figure.savefig(out / f"tour_{shape}.png")
        assert summary["completed"]
        assert tuple(leg["piece"] for leg in summary["legs"]) == tour
        assert summary["cross_track_rms_m"] <= LARGEST_RMS
        assert summary["speed_min_m_s"] >= LEAST_SPEED
        assert summary["motor_force_min_n"] > 0.0
        assert summary["motor_force_max_n"] < summary["motor_force_limit_n"]
    save(rows, f"tour_{shape}")
