"""Flights from the edge of the set of a proof, in the largest disturbance that it tolerates.

python -m tests.benchmarks.vehicle_flights FOLDER --flights 200

FOLDER is that of `sgvf certify --speed V --vehicle`.  The loop acts in continuous time, and at
100 Hz with --hold.  Prints the largest errors beside the proved ones, and draws the flights.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from sgvf_drake.certificate import Certificate
from sgvf_drake.experiments.certify import FLOWN_FIELD
from sgvf_drake.fields import load_guiding_field
from systems import Disturbance, MakeFlightDiagram, MakeSimulator, QuadrotorParameters
from systems.controller import DEFAULT_GAINS
from systems.diagrams import SetVehicleState
from systems.guidance import DIFFERENCE_TIME, CalcCommandAt, CalcDerivatives
from systems.se3_law import CalcDesiredAttitude, CalcThrustRates

ALTITUDE, DURATION, LOG_PERIOD = 1.0, 4.0, 0.01
# Of the wind, m/s: so fast that its pull hardly depends on the vehicle's own velocity.
FAST = 100.0


def direction(rng, dim):
    """A random unit vector."""
    v = rng.normal(size=dim)
    return v / np.linalg.norm(v)


def start_state(field, law, start, position, rng):
    """A state with the errors of the edge of the set, in random directions."""
    v = np.append(law.speed * field(position), 0) + np.append(
        start.velocity * direction(rng, 2), start.climb * rng.choice([-1, 1])
    )
    p = np.append(position, ALTITUDE)
    places = []
    for h in (-DIFFERENCE_TIME, 0.0, DIFFERENCE_TIME):
        m, J = (part[0] for part in field.value_and_jacobian((p + h * v)[None, :2]))
        values = np.concatenate([m, J.ravel()])
        places.append(CalcCommandAt(values, p + h * v, law.speed, ALTITUDE))
    U, DU = places[1]
    derivatives, a, k, g = CalcDerivatives(places, v), DU @ v, law.velocity_gain, law.gravity
    q = a - k * (v - U) + [0, 0, g]
    R_d, *_ = CalcDesiredAttitude(q, (0.0,) * 3, (0.0,) * 3, 0.0, False)
    turn = np.arcsin(start.attitude) * direction(rng, 3)
    R = np.column_stack(R_d) @ Rotation.from_rotvec(turn).as_matrix()
    columns = tuple(R.T)
    body, wanted = np.zeros(3), start.rate * direction(rng, 3)
    # The desired rate depends on the body's own, weakly.
    for _ in range(30):
        rates = CalcThrustRates(q, columns, body, a, derivatives, np.zeros(3), 1.0, k, g)
        _, omega, _ = CalcDesiredAttitude(q, *rates, 0.0, False)
        body = R.T @ np.array(omega) + wanted
    yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX")
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turning = np.linalg.solve([[1, 0, -sp], [0, cr, cp * sr], [0, -sr, cp * cr]], body)
    return np.concatenate([p, [roll, pitch, yaw], v, turning])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--hold", action="store_true")
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    found = Certificate.load(given.folder / "certificate.json")
    result = found.vehicle
    assert result is not None
    field = load_guiding_field(given.folder / FLOWN_FIELD)
    metric, law = field.rescaled(result.scale), result.law
    drag = law.mass * result.disturbance / (FAST + 2 * law.speed)
    disturbance = Disturbance(wind=(FAST, 0.0, 0.0), drag=max(drag, 1e-12))
    diagram = MakeFlightDiagram(
        metric,
        QuadrotorParameters(),
        disturbance=disturbance,
        log_period=None,
        speed=law.speed,
        altitude=ALTITUDE,
        gains=DEFAULT_GAINS,
        jerk_feedforward=True,
        sample_period=LOG_PERIOD if given.hold else 0.0,
    )
    plant = diagram.GetSubsystemByName("plant")
    rng = np.random.default_rng(0)
    simulator = MakeSimulator(diagram)
    figure, axes = plt.subplots(1, 2, figsize=(13, 6))
    for number, piece in enumerate(result.pieces):
        if piece is None or piece.failures:
            continue
        walls, tube, pair = found.walls[number], found.tubes[number], piece.proposal.pairs - 1
        assert walls is not None
        assert tube is not None
        ends = [field.cloud.denormalize(walls.polygons(side)[pair]) for side in (1, -1)]
        worst, late, force, outside = 0.0, 0.0, [], 0
        for _ in range(given.flights):
            side = ends[rng.integers(2)]
            inward = field.cloud.denormalize(tube.rows[:-1, 0])
            k = rng.integers(len(side))
            position = 0.999 * side[k] + 0.001 * inward[k]
            state = start_state(metric, law, piece.proposal.start, result.scale * position, rng)
            turn = rng.uniform(0, 2 * np.pi)
            wind = (FAST * np.cos(turn), FAST * np.sin(turn), 0.0)
            context = simulator.get_mutable_context()
            context.SetTime(0.0)
            diagram.SetDefaultContext(context)
            plant.SetDisturbance(context, Disturbance(wind=wind, drag=disturbance.drag))
            SetVehicleState(diagram, context, state)
            simulator.Initialize()
            track = []
            for time in np.arange(0, DURATION, LOG_PERIOD):
                simulator.AdvanceTo(time)
                track.append(diagram.GetOutputPort("state").Eval(context))
            track = np.array(track)
            error = np.linalg.norm(track[:, 6:8] - law.speed * metric(track[:, :2]), axis=1)
            inside = walls[: pair + 1].count_around(
                field.cloud.normalize(track[:, :2] / result.scale)
            )
            outside += int((inside[1:] == 0).any())
            worst, late = max(worst, error.max()), max(late, error[-100:].max())
            axes[0].plot(*track[:, :2].T, lw=0.3, color="tab:orange")
            axes[1].plot(np.arange(len(error)) * LOG_PERIOD, error, lw=0.3, color="tab:orange")
            force.append(np.abs(track[:, 3:5]).max())
        for side in ends:
            axes[0].plot(*(result.scale * np.vstack([side, side[:1]])).T, lw=0.8, color="k")
        line = axes[1].axhline(piece.velocity_error, color=f"C{number}", ls="--")
        line.set_label(f"proved, piece {number + 1}")
        axes[1].axhline(piece.tolerated, color=f"C{number}", label="tolerated by its walls")
        print(
            f"piece {number + 1}: walls {piece.half_width:.4f} m, d {result.disturbance:.3g}; "
            f"|e| {worst:.4f} of {piece.velocity_error:.4f} proved, at last {late:.4f} of "
            f"{piece.final.velocity:.4f}; walls tolerate {piece.tolerated:.4f}; tilt "
            f"{max(force):.3f}; {outside} of {given.flights} outside",
            flush=True,
        )
    axes[0].set(aspect="equal", xlabel="x, m", ylabel="y, m", title="flights between walls")
    axes[1].set(xlabel="time, s", ylabel="|e|, m/s", yscale="log", title="velocity error")
    axes[1].legend()
    if given.figure is not None:
        figure.savefig(given.figure, dpi=110, bbox_inches="tight")


if __name__ == "__main__":
    main()
