"""Guiding vector fields as Drake systems, and the quadrotor that they fly.

As in Drake, ``Add...(builder, ...)`` changes a builder and ``Make...`` returns something new.
"""

from systems.controller import DEFAULT_GAINS, Se3Controller, Se3Controller_
from systems.diagrams import (
    AddGuidance,
    GuidanceParts,
    MakeFlightDiagram,
    MakeSimulator,
    SetHover,
    SetVehicleState,
)
from systems.guidance import FieldForSpeed, GuidanceSystem, GuidanceSystem_
from systems.kinematic import (
    KinematicGuidance,
    KinematicGuidance_,
    MakeKinematicDiagram,
    SetPositions,
)
from systems.lyapunov_monitor import (
    AddLyapunovMonitor,
    DifferentiableFunction,
    LyapunovMonitor,
    LyapunovMonitor_,
)
from systems.quadrotor import QuadrotorParameters
from systems.se3_law import Body, Gains
from systems.sensing import AddMotionCapture
from systems.stop_on_exit import ExitWatch, StopOnExit, SublevelExit

__all__ = [
    "DEFAULT_GAINS",
    "AddGuidance",
    "AddLyapunovMonitor",
    "AddMotionCapture",
    "Body",
    "DifferentiableFunction",
    "ExitWatch",
    "FieldForSpeed",
    "Gains",
    "GuidanceParts",
    "GuidanceSystem",
    "GuidanceSystem_",
    "KinematicGuidance",
    "KinematicGuidance_",
    "LyapunovMonitor",
    "LyapunovMonitor_",
    "MakeFlightDiagram",
    "MakeKinematicDiagram",
    "MakeSimulator",
    "QuadrotorParameters",
    "Se3Controller",
    "Se3Controller_",
    "SetHover",
    "SetPositions",
    "SetVehicleState",
    "StopOnExit",
    "SublevelExit",
]
