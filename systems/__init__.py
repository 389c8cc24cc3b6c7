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
from systems.flight_trail import AddFlightTrail, FlightTrail
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
from systems.quadrotor_geometry import AddQuadrotorGeometry, QuadrotorGeometry
from systems.scene_drawing import DrawField, DrawTube, DrawWaypoints
from systems.se3_law import Body, Gains
from systems.sensing import AddMotionCapture
from systems.stop_on_exit import ExitWatch, StopOnExit, SublevelExit
from systems.visualization import (
    AddFlightVisualization,
    FlightVisualization,
    MakeMeshcat,
    SaveRecording,
    SetView,
)

__all__ = [
    "DEFAULT_GAINS",
    "AddFlightTrail",
    "AddFlightVisualization",
    "AddGuidance",
    "AddLyapunovMonitor",
    "AddMotionCapture",
    "AddQuadrotorGeometry",
    "Body",
    "DifferentiableFunction",
    "DrawField",
    "DrawTube",
    "DrawWaypoints",
    "ExitWatch",
    "FieldForSpeed",
    "FlightTrail",
    "FlightVisualization",
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
    "MakeMeshcat",
    "MakeSimulator",
    "QuadrotorGeometry",
    "QuadrotorParameters",
    "SaveRecording",
    "Se3Controller",
    "Se3Controller_",
    "SetHover",
    "SetPositions",
    "SetVehicleState",
    "SetView",
    "StopOnExit",
    "SublevelExit",
]
