"""Guiding vector fields as Drake systems, and the vehicles that follow them.

As in Drake, ``Add...(builder, ...)`` changes a builder and ``Make...`` returns something new.
"""

from systems.branch_supervisor import BranchSupervisor, BranchSupervisor_
from systems.branches import Branch, BranchAlong, MakeBranches
from systems.controller import (
    DEFAULT_GAINS,
    DISTURBANCE_BANDWIDTH,
    Se3Controller,
    Se3Controller_,
)
from systems.course_controller import CourseController, CourseController_
from systems.diagrams import (
    MakeFlightDiagram,
    MakeSimulator,
    SetHover,
    SetNoiseSeed,
    SetVehicleState,
)
from systems.disturbances import Disturbance, DisturbedQuadrotor
from systems.fused_guidance import FusedGuidance, FusedGuidance_
from systems.guidance import FieldForSpeed, GuidanceSystem, GuidanceSystem_
from systems.guidance_loop import AddGuidance, GuidanceLoop
from systems.heading import HeadingSystem, HeadingSystem_
from systems.kinematic import (
    KinematicGuidance,
    KinematicGuidance_,
    MakeKinematicDiagram,
    SetPositions,
)
from systems.live_controls import Change, Control, LiveControls
from systems.lyapunov_monitor import (
    AddLyapunovMonitor,
    DifferentiableFunction,
    ExitWatch,
    LyapunovMonitor,
    LyapunovMonitor_,
    StopOnExit,
    SublevelExit,
)
from systems.moving_scene import (
    AddFlightTrail,
    AddQuadrotorGeometry,
    FlightTrail,
    QuadrotorGeometry,
)
from systems.multibody import (
    AddMultibodyQuadrotor,
    FloatingBodyState,
    FloatingBodyState_,
    MultibodyQuadrotor,
    MultibodyQuadrotorSdf,
    MultibodyVehicle,
    QuadrotorInPlant,
)
from systems.navigation import RouteNavigator, RouteNavigator_
from systems.planar_vehicle import (
    PlanarVehicle,
    PlanarVehicle_,
    PlanarVehicleInWind,
    PlanarVehicleParameters,
)
from systems.quadrotor import QuadrotorParameters
from systems.scene_drawing import DrawField, DrawTube, DrawWaypoints
from systems.se3_law import Body, Gains
from systems.sensing import (
    Dropout,
    Dropout_,
    IdealMotionCapture,
    MotionCapture,
    SensorParameters,
)
from systems.spacing import AddSpacing, Pace, SpacingController, SpacingController_
from systems.state_estimator import StateEstimator, StateEstimator_
from systems.supervision import HOLD_POSITION, ON_TOUR, Mode
from systems.turning_vehicles import FixedWing, Unicycle
from systems.vehicle import Feasibility, Quadrotor, Vehicle
from systems.vehicles import VEHICLES, VehicleNamed
from systems.visualization import (
    AddFlightVisualization,
    FlightVisualization,
    MakeMeshcat,
    SaveRecording,
    SetView,
)

__all__ = [
    "DEFAULT_GAINS",
    "DISTURBANCE_BANDWIDTH",
    "HOLD_POSITION",
    "ON_TOUR",
    "VEHICLES",
    "AddFlightTrail",
    "AddFlightVisualization",
    "AddGuidance",
    "AddLyapunovMonitor",
    "AddMultibodyQuadrotor",
    "AddQuadrotorGeometry",
    "AddSpacing",
    "Body",
    "Branch",
    "BranchAlong",
    "BranchSupervisor",
    "BranchSupervisor_",
    "Change",
    "Control",
    "CourseController",
    "CourseController_",
    "DifferentiableFunction",
    "Disturbance",
    "DisturbedQuadrotor",
    "DrawField",
    "DrawTube",
    "DrawWaypoints",
    "Dropout",
    "Dropout_",
    "ExitWatch",
    "Feasibility",
    "FieldForSpeed",
    "FixedWing",
    "FlightTrail",
    "FlightVisualization",
    "FloatingBodyState",
    "FloatingBodyState_",
    "FusedGuidance",
    "FusedGuidance_",
    "Gains",
    "GuidanceLoop",
    "GuidanceSystem",
    "GuidanceSystem_",
    "HeadingSystem",
    "HeadingSystem_",
    "IdealMotionCapture",
    "KinematicGuidance",
    "KinematicGuidance_",
    "LiveControls",
    "LyapunovMonitor",
    "LyapunovMonitor_",
    "MakeBranches",
    "MakeFlightDiagram",
    "MakeKinematicDiagram",
    "MakeMeshcat",
    "MakeSimulator",
    "Mode",
    "MotionCapture",
    "MultibodyQuadrotor",
    "MultibodyQuadrotorSdf",
    "MultibodyVehicle",
    "Pace",
    "PlanarVehicle",
    "PlanarVehicleInWind",
    "PlanarVehicleParameters",
    "PlanarVehicle_",
    "Quadrotor",
    "QuadrotorGeometry",
    "QuadrotorInPlant",
    "QuadrotorParameters",
    "RouteNavigator",
    "RouteNavigator_",
    "SaveRecording",
    "Se3Controller",
    "Se3Controller_",
    "SensorParameters",
    "SetHover",
    "SetNoiseSeed",
    "SetPositions",
    "SetVehicleState",
    "SetView",
    "SpacingController",
    "SpacingController_",
    "StateEstimator",
    "StateEstimator_",
    "StopOnExit",
    "SublevelExit",
    "Unicycle",
    "Vehicle",
    "VehicleNamed",
]
