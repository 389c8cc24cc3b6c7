"""How a flight starts: the state of the vehicle, and of what has measured it."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.framework import Context, Diagram, Diagram_
from pydrake.systems.primitives import PassThrough, PassThrough_

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems.quadrotor import STATE_SIZE
from systems.sensing import MotionCapture


def SetHover(diagram: Diagram, context: Context, position: ArrayLike) -> None:
    """Sets a flight to hover, level and at rest.

    Args:
        diagram: From `MakeFlightDiagram`, or any with systems "plant" and "motion_capture".
        context: Of the diagram.
        position: p_WB of shape (3,) in m.

    Raises:
        ConfigurationError: if the shape is wrong.
        NonFiniteValueError: if the position is not finite.
    """
    p_WB = np.asarray(position, dtype=np.float64)
    if p_WB.shape != (3,):
        raise ConfigurationError(f"position must have shape (3,), got {p_WB.shape}")
    SetVehicleState(diagram, context, np.concatenate((p_WB, np.zeros(STATE_SIZE - 3))))


def SetVehicleState(diagram: Diagram, context: Context, state: ArrayLike) -> None:
    """Sets the state of the vehicle, and of the motion capture that has just seen it.

    Args:
        diagram: From `MakeFlightDiagram`, or any with systems "plant" and "motion_capture".
        context: Of the diagram.
        state: Of shape (12,), as QuadrotorPlant's.

    Raises:
        ConfigurationError: if the shape is wrong, or the diagram is a converted or cloned one
            with sensors.
        NonFiniteValueError: if the state is not finite.
    """
    values: Any = np.asarray(state, dtype=np.float64)
    if values.shape != (STATE_SIZE,):
        raise ConfigurationError(f"state must have shape ({STATE_SIZE},), got {values.shape}")
    if not np.isfinite(values).all():
        raise NonFiniteValueError(f"the vehicle's state must be finite: {values.tolist()}")
    plant = diagram.GetSubsystemByName("plant")
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(values)
    capture: Any = diagram.GetSubsystemByName("motion_capture")
    if isinstance(capture, (PassThrough, PassThrough_[AutoDiffXd])):
        return
    _CheckBuilt(capture)
    capture.SetVectorState(capture.GetMyMutableContextFromRoot(context), values)


def SetNoiseSeed(diagram: Diagram, context: Context, seed: int) -> None:
    """Sets the seed of a flight's measurements, so that it repeats exactly.

    Measurements without noise need none, and take none.

    Args:
        diagram: From `MakeFlightDiagram`, or any with a system "motion_capture".
        context: Of the diagram.
        seed: Not negative.

    Raises:
        ConfigurationError: if the diagram is a converted or cloned one with sensors.
    """
    capture: Any = diagram.GetSubsystemByName("motion_capture")
    _CheckBuilt(capture)
    if isinstance(capture, MotionCapture):
        capture.SetNoiseSeed(capture.GetMyMutableContextFromRoot(context), seed)


def _CheckBuilt(capture: Any) -> None:
    """Raises ConfigurationError on what Drake has made of a `MotionCapture`."""
    if isinstance(capture, (Diagram, Diagram_[AutoDiffXd])) and not isinstance(
        capture, MotionCapture
    ):
        raise ConfigurationError(
            "converted or cloned sensors have no start and no seed to set: set them in a "
            "Context of the diagram that was built, and take them over by "
            "SetTimeStateAndParametersFrom"
        )
