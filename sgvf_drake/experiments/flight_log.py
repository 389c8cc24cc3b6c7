"""A flight simulated from a hover, and its logs as one table."""

from contextlib import nullcontext

import pandas as pd
from pydrake.systems.framework import Context, Diagram

from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import FloatArray
from sgvf_drake.progress import Progress, no_progress
from systems import MakeSimulator, SetHover, SetNoiseSeed

LOG_PERIOD = 0.01
STATE_COLUMNS = (
    *("x", "y", "z", "roll", "pitch", "yaw"),
    *("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate"),
)
COMMAND_COLUMNS = ("vx_command", "vy_command", "vz_command")
FORCE_COLUMNS = ("force_1", "force_2", "force_3", "force_4")


def simulate(
    diagram: Diagram,
    start: FloatArray,
    duration: float,
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
    name: str = "flight",
    seed: int = 0,
) -> tuple[pd.DataFrame, float]:
    """Flies from a hover; returns the log and the wall time in seconds.

    Args:
        diagram: From `MakeFlightDiagram`.
        start: p_WB of the hover, (3,) in m.
        duration: In s.
        progress: Told how far it is.
        scene: Shows the flight; the diagram was made with its meshcat.
        name: Of the flight, and of the page that the scene leaves.
        seed: Of the noise of the measurements, where they have any.
    """
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, start)
    SetNoiseSeed(diagram, context, seed)
    with nullcontext() if scene is None else scene.show(simulator, name):
        wall_s = advance(simulator, duration, LOG_PERIOD, "fly", progress)
    return flight_log(diagram, context), wall_s


def flight_log(diagram: Diagram, context: Context) -> pd.DataFrame:
    """Returns what the logs of a flight diagram hold, as one table."""
    tables = []
    for name, columns in (
        ("state_log", STATE_COLUMNS),
        ("velocity_command_log", COMMAND_COLUMNS),
        ("propeller_force_log", FORCE_COLUMNS),
    ):
        times, values = read_log(diagram, context, name)
        tables.append(pd.DataFrame(values, columns=list(columns)))
    return pd.concat([pd.Series(times, name="time"), *tables], axis=1)
