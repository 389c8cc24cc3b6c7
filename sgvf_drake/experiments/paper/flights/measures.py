"""How smooth and how bounded a flight was, from its log."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from sgvf_drake.experiments.flight import FORCE_COLUMNS, TAKE_OFF_S

VELOCITY_COLUMNS = ("vx", "vy", "vz")


@dataclass(frozen=True)
class Motion:
    """Motion and motor inputs of a flight after its take-off.

    Attributes:
        speed_min_m_s: Least speed.
        speed_max_m_s: Top speed.
        acceleration_max_m_s2: Largest acceleration, from one sample to the next.
        jerk_rms_m_s3: Root mean square of its rate of change, in the horizontal plane.
        velocity_step_m_s: Largest change of the velocity in one sample (10 ms).
        force_min_n: Least force of a propeller.
        force_max_n: Largest force of a propeller.
        force_step_n: Largest change of it in one sample.
    """

    speed_min_m_s: float
    speed_max_m_s: float
    acceleration_max_m_s2: float
    jerk_rms_m_s3: float
    velocity_step_m_s: float
    force_min_n: float
    force_max_n: float
    force_step_n: float


def motion_of(log: pd.DataFrame) -> Motion:
    """Returns the motion of a flight, from the log of `fly` or `fly_tour`."""
    flown = log[log["time"] > TAKE_OFF_S]
    times = flown["time"].to_numpy(dtype=np.float64)
    velocity = flown[list(VELOCITY_COLUMNS)].to_numpy(dtype=np.float64)
    forces = flown[list(FORCE_COLUMNS)].to_numpy(dtype=np.float64)
    period = (times[-1] - times[0]) / (len(times) - 1)
    steps = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    jerk = np.diff(velocity[:, :2], 2, axis=0) / period**2
    speed = np.linalg.norm(velocity, axis=1)
    return Motion(
        speed_min_m_s=float(speed.min()),
        speed_max_m_s=float(speed.max()),
        acceleration_max_m_s2=float(steps.max() / period),
        jerk_rms_m_s3=float(np.sqrt((jerk**2).sum(axis=1).mean())),
        velocity_step_m_s=float(steps.max()),
        force_min_n=float(forces.min()),
        force_max_n=float(forces.max()),
        force_step_n=float(np.abs(np.diff(forces, axis=0)).max()),
    )
