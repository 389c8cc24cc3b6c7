"""Flights under the default law and under the one that is told how its command changes.

python -m tests.benchmarks.jerk_feedforward FIELD

FIELD is in metres.  The quadrotor hovers beside the last piece of the path at first, and the
second half of 12 s counts: the RMS distance from the path, and the largest velocity error.
"""

import argparse
from pathlib import Path
import time

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from sgvf_drake.fields import load_guiding_field
from systems import (
    AddGuidance,
    Disturbance,
    DisturbedQuadrotor,
    GuidanceSystem,
    MakeSimulator,
    QuadrotorParameters,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
)
from systems.controller import DEFAULT_GAINS, DISTURBANCE_BANDWIDTH

DURATION, ALTITUDE, BESIDE = 12.0, 1.0, 0.15
COMPENSATING = DEFAULT_GAINS._replace(disturbance_bandwidth=DISTURBANCE_BANDWIDTH)
WIND = Disturbance(wind=(3.0, 0.0, 0.0))
CASES = {
    "ideal": ({}, Disturbance(drag=0.0)),
    "sensors": ({"sensors": SensorParameters()}, Disturbance(drag=0.0)),
    "motors lag by 30 ms": ({}, Disturbance(drag=0.0, motor_lag=0.03)),
    "drag": ({}, Disturbance()),
    "sensors, wind": ({"sensors": SensorParameters(), "gains": COMPENSATING}, WIND),
}


def fly(field, piece, speed, rate, jerk, options, disturbance):
    """The RMS distance, m, the largest velocity error, m/s, and the CPU time, s."""
    builder = DiagramBuilder()
    plant = DisturbedQuadrotor(QuadrotorParameters(), disturbance)
    builder.AddNamedSystem("plant", plant)
    guidance = GuidanceSystem(field, speed, ALTITUDE, True, rate)
    AddGuidance(
        builder, guidance, plant, QuadrotorParameters(), jerk_feedforward=jerk, **options
    )
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, 0.01)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, [*(piece.vertices[0] + BESIDE), ALTITUDE])
    SetNoiseSeed(diagram, context, 0)
    flown = guidance.GetFlownField(guidance.GetMyContextFromRoot(context))
    started = time.process_time()
    simulator.AdvanceTo(DURATION)
    used = time.process_time() - started
    states = log.FindLog(context).data().T
    states = states[len(states) // 2 :]
    errors = np.linalg.norm(states[:, 6:8] - speed * flown(states[:, :2]), axis=1)
    return np.sqrt(np.mean(field.path.project(states[:, :2]).distance ** 2)), errors.max(), used


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("field", type=Path)
    field = load_guiding_field(parser.parse_args().field)
    piece = field.path.pieces[-1]
    for case, settings in CASES.items():
        for speed, rate in ((0.45, 4.0), (0.45, 20.0), (2.0, 4.0), (2.0, 20.0)):
            told = (fly(field, piece, speed, rate, jerk, *settings) for jerk in (False, True))
            flights = ", ".join(
                f"{1e3 * distance:.1f} mm {error:.4f} m/s in {used:.2f} s"
                for distance, error, used in told
            )
            print(f"{case}, {speed:g} m/s, {rate:g} /s: {flights}", flush=True)


if __name__ == "__main__":
    main()
