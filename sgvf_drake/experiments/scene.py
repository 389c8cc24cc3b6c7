"""A flight as a scene in Meshcat: what stands still, and the recording."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from sgvf_drake.fields import DirectedField, FloatArray, GuidingField
from systems import (
    DrawField,
    DrawTube,
    DrawWaypoints,
    FieldForSpeed,
    MakeMeshcat,
    SaveRecording,
    SetView,
)


@dataclass(frozen=True, eq=False)
class FlightScene:
    """Where a flight is shown.

    Attributes:
        meshcat: Drake's viewer.
        pages: The folder for a recording of each flight, a page that needs no network; None:
            nothing is recorded.
        live: Whether flights keep the pace of the clock, for somebody who watches.
        tube: The border of the tube where one is known, polylines (k, 2) in m.
    """

    meshcat: Meshcat
    pages: Path | None = None
    live: bool = False
    tube: Sequence[FloatArray] = ()

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
    def show(self, simulator: Simulator, name: str) -> Iterator[None]:
        """Shows what is simulated inside; leaves the page NAME.html if pages are wanted.

        Args:
            simulator: Of a diagram from `MakeFlightDiagram` with this scene's meshcat.
            name: Of the page.
        """
        diagram: Any = simulator.get_system()
        visualizer = diagram.GetSubsystemByName("meshcat_visualizer")
        if self.pages is not None:
            visualizer.StartRecording()
        if self.live:
            simulator.set_target_realtime_rate(1.0)
        yield
        diagram.GetSubsystemByName("trail").DrawToEnd(simulator.get_context())
        if self.pages is not None:
            visualizer.StopRecording()
            SaveRecording(self.meshcat, self.pages / f"{name}.html")
            visualizer.DeleteRecording()


@dataclass(frozen=True, eq=False)
class View:
    """How somebody wants to watch flights.

    Attributes:
        pages: Whether each flight leaves a page with its recording.
        meshcat: Where to watch it live; None: nowhere.
        tube: The border of the tube where one is known, polylines (k, 2) in m.
    """

    pages: bool = False
    meshcat: Meshcat | None = None
    tube: Sequence[FloatArray] = ()

    def scene(self, folder: Path) -> FlightScene | None:
        """Returns the scene for flights that leave their results in a folder."""
        if not self.pages and self.meshcat is None:
            return None
        return FlightScene(
            self.meshcat or MakeMeshcat(port=0),
            folder if self.pages else None,
            self.meshcat is not None,
            self.tube,
        )


NO_VIEW = View()
