"""A flight as a scene in Meshcat: what stands still, and the recording."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from sgvf_drake.exceptions import NonFiniteValueError
from sgvf_drake.experiments.certified import CertifiedField
from sgvf_drake.fields import DirectedField, FloatArray, GuidingField
from systems import (
    DrawField,
    DrawTube,
    DrawWaypoints,
    FieldForSpeed,
    LiveControls,
    MakeMeshcat,
    SaveRecording,
    SetView,
)
from systems.quadrotor import POSITION, VELOCITY

LOOP = "guidance_loop"
# What stands beside the gauges, whose figures are parts of the speed.
MARGIN_GAUGES = ("velocity error", "margin e*")


@dataclass(frozen=True, eq=False)
class FlightScene:
    """Where a flight is shown.

    Attributes:
        meshcat: Drake's viewer.
        pages: The folder for a recording of each flight, a page that needs no network; None:
            nothing is recorded.
        live: Whether flights keep the pace of the clock, for somebody who watches, and can be
            changed by sliders.
        tube: The border of the tube, or walls, where they are known, polylines (k, 2) in m.
        certified: What a certificate proves of the field, which the velocity error is shown
            against; None: nothing.
    """

    meshcat: Meshcat
    pages: Path | None = None
    live: bool = False
    tube: Sequence[FloatArray] = ()
    certified: CertifiedField | None = None

    def draw(self, field: GuidingField | DirectedField, speed: float, altitude: float) -> None:
        """Draws what stands still: the waypoints, the field as it is flown, the tube.

        A directed field has no arrows: they differ with the heading.

        Args:
            field: In metres.
            speed: Of the flight, m/s.
            altitude: Of what is planar, m; a spatial field is cut in the middle of its path.
        """
        cloud = field.cloud
        if field.dim == 3:
            altitude = float(np.mean([bound[2] for bound in cloud.box]))
        SetView(self.meshcat, cloud.box, altitude)
        DrawWaypoints(self.meshcat, cloud.points, altitude)
        if not isinstance(field, DirectedField):
            DrawField(self.meshcat, FieldForSpeed(field, speed), cloud.box, altitude)
        if self.tube:
            DrawTube(self.meshcat, self.tube, altitude)

    @contextmanager
    def show(
        self, simulator: Simulator, name: str, top_speed: float | None = None
    ) -> Iterator[LiveControls | None]:
        """Shows what is simulated inside; leaves the page NAME.html if pages are wanted.

        Gives what the flight can be changed by while it is simulated; None if it is not live.

        Args:
            simulator: Of a diagram from `MakeFlightDiagram` with this scene's meshcat.
            name: Of the page.
            top_speed: The end of the slider of the speed, m/s; see `LiveControls`.
        """
        diagram: Any = simulator.get_system()
        visualizer = diagram.GetSubsystemByName("meshcat_visualizer")
        if self.pages is not None:
            visualizer.StartRecording()
        controls = None
        if self.live:
            simulator.set_target_realtime_rate(1.0)
            controls = LiveControls(
                self.meshcat,
                diagram,
                simulator.get_context(),
                top_speed=top_speed,
                gauges=self._gauges(diagram),
            )
        try:
            yield controls
        finally:
            if controls is not None:
                controls.Remove()
        # Where a vehicle out of control is, may be nowhere.
        with suppress(NonFiniteValueError):
            diagram.GetSubsystemByName("trail").DrawToEnd(simulator.get_context())
        if self.pages is not None:
            visualizer.StopRecording()
            SaveRecording(self.meshcat, self.pages / f"{name}.html")
            visualizer.DeleteRecording()

    def _gauges(self, diagram: Any) -> dict[str, Callable[[Context], float]]:
        """Returns the velocity error and the margin, where a certificate proves one."""
        if self.certified is None:
            return {}
        certified, guidance = self.certified, diagram.GetSubsystemByName(LOOP).guidance
        state_port = diagram.GetOutputPort("state")

        def figure(number: int, context: Context) -> float:
            state = state_port.Eval(context)
            speed = guidance.GetSpeed(guidance.GetMyContextFromRoot(context))
            motion = state[POSITION][:2], state[VELOCITY][:2]
            return certified.error_and_margin(*motion, speed)[number]

        return {name: partial(figure, number) for number, name in enumerate(MARGIN_GAUGES)}


@dataclass(frozen=True, eq=False)
class View:
    """How somebody wants to watch flights.

    Attributes:
        pages: Whether each flight leaves a page with its recording.
        meshcat: Where to watch it live; None: nowhere.
        tube: The border of the tube, or walls, where they are known, polylines (k, 2) in m.
    """

    pages: bool = False
    meshcat: Meshcat | None = None
    tube: Sequence[FloatArray] = ()

    def scene(
        self, folder: Path, certified: CertifiedField | None = None
    ) -> FlightScene | None:
        """Returns the scene for flights that leave their results in a folder.

        Args:
            folder: The folder.
            certified: What is proved of the field that is flown; None: nothing.
        """
        if not self.pages and self.meshcat is None:
            return None
        return FlightScene(
            self.meshcat or MakeMeshcat(port=0),
            folder if self.pages else None,
            self.meshcat is not None,
            self.tube,
            certified,
        )


NO_VIEW = View()
