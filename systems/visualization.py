"""Watching a flight in Meshcat, live or as a page that needs no network."""

import math
import os
from pathlib import Path
import tempfile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    SceneGraph,
)
from pydrake.systems.framework import DiagramBuilder, OutputPort

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from systems.moving_scene import (
    AddFlightTrail,
    AddQuadrotorGeometry,
    FlightTrail,
    QuadrotorGeometry,
)
from systems.quadrotor import QuadrotorParameters
from systems.scalars import CheckFiniteParameter
from systems.scene_drawing import PlaneBox

LOCAL_HOST = "localhost"
"""Drake's own default listens on every network interface."""

PORTS = range(1024, 65536)
"""That can be asked for: Drake aborts the process below, and counts anew above."""

PUBLISH_PERIOD = 1.0 / 32.0
"""s; of the pictures, and of the frames of a recording."""

DISPLAY_SCALE = 2.0
"""Times which the quadrotor is drawn larger: the paper's has 15 cm in a scene of 5 m."""

BACKGROUND_COLOR = [1.0, 1.0, 1.0]

FIELD_OF_VIEW = math.radians(75.0)
"""Of Meshcat's camera, from top to bottom."""

VIEW_ASPECT = 1.5
"""Width over height of the narrowest window that shows the whole box."""

VIEW_MARGIN = 0.95
"""The part of the window that the box may fill."""

VIEW_ELEVATION = math.radians(65.0)
"""Of the camera over the plane of flight, seen from the middle of the box."""


class FlightVisualization(NamedTuple):
    """What `AddFlightVisualization` adds to a diagram.

    Attributes:
        scene_graph: Drake's, for more geometry, cameras and sensors.
        visualizer: Drake's MeshcatVisualizer.
        geometry: The `QuadrotorGeometry`.
        trail: The `FlightTrail`.
    """

    scene_graph: SceneGraph
    visualizer: MeshcatVisualizer
    geometry: QuadrotorGeometry
    trail: FlightTrail


def MakeMeshcat(host: str = LOCAL_HOST, port: int | None = None) -> Meshcat:
    """Returns a Meshcat that only this machine can reach.

    It serves until it is deleted; its address is ``meshcat.web_url()``.

    Args:
        host: To listen on; "*" for every network interface.
        port: By default the first free one from 7000 on; 0 for any free one.

    Raises:
        ConfigurationError: if nothing can listen there.
    """
    if port not in (None, 0) and port not in PORTS:
        raise ConfigurationError(
            f"port must be from {PORTS.start} to {PORTS.stop - 1}, or 0, got {port}"
        )
    try:
        return Meshcat(MeshcatParams(host=host, port=port))
    except RuntimeError as error:
        where = host if port is None else f"{host}:{port}"
        raise ConfigurationError(f"cannot listen on {where}: {error}") from None


def AddFlightVisualization(
    builder: DiagramBuilder,
    state_port: OutputPort,
    parameters: QuadrotorParameters,
    meshcat: Meshcat,
    *,
    publish_period: float = PUBLISH_PERIOD,
    scale: float = DISPLAY_SCALE,
    name: str = "quadrotor",
    beside: FlightVisualization | None = None,
) -> FlightVisualization:
    """Shows a quadrotor and its trail in Meshcat while it flies.

    Adds the systems "scene_graph", "quadrotor_geometry", "meshcat_visualizer" and "trail".
    Another vehicle is shown `beside` the first, in its scene, by another name: that adds
    "<name>_geometry" and "<name>_trail".  The diagram can then no longer be converted to
    AutoDiffXd.  What stands still is drawn by `DrawWaypoints`, `DrawField` and `DrawTube`, and
    seen well from where `SetView` looks.

    To record, call ``visualizer.StartRecording()`` before the flight.  It takes its frame
    rate from the publish period; Meshcat's own default of 64 Hz fits no other period.
    After the flight, ``trail.DrawToEnd(context)`` draws the rest of the trail, and
    `SaveRecording` makes a page of it all.

    Args:
        builder: Is changed.
        state_port: The vehicle's state (12), as QuadrotorPlant's.
        parameters: The vehicle, for its size.
        meshcat: Is drawn to.
        publish_period: In s, a power of two: a recording's frame is the floor of time times
            rate, which for other periods rounds into the frame before, and leaves gaps.
        scale: Times which the quadrotor is drawn larger than it is.
        name: The name of the vehicle in the scene.
        beside: What shows another vehicle of this diagram already; None: nothing does.

    Returns:
        The systems that show the vehicle.

    Raises:
        ConfigurationError: if an argument cannot be used.
    """
    # A power of two has no digits but its exponent.
    if not (publish_period > 0.0 and math.frexp(publish_period)[0] == 0.5):
        raise ConfigurationError(
            f"publish_period must be a power of two, such as 1/32 s, got {publish_period}"
        )
    for taken in (f"{name}_geometry", "scene_graph" if beside is None else f"{name}_trail"):
        if builder.HasSubsystemNamed(taken):
            raise ConfigurationError(
                f"the diagram has a system {taken!r} already: show another vehicle `beside` "
                "the first, by another `name`"
            )
    scene_graph: Any
    if beside is None:
        scene_graph, trail_name = builder.AddNamedSystem("scene_graph", SceneGraph()), "trail"
        visualizer = MeshcatVisualizer.AddToBuilder(
            builder,
            scene_graph,
            meshcat,
            MeshcatVisualizerParams(publish_period=publish_period),
        )
        visualizer.set_name("meshcat_visualizer")
    else:
        scene_graph, visualizer, trail_name = *beside[:2], f"{name}_trail"
    geometry = AddQuadrotorGeometry(
        builder, state_port, scene_graph, parameters, name, scale=scale
    )
    trail = AddFlightTrail(builder, state_port, meshcat, f"/{trail_name}", name=trail_name)
    return FlightVisualization(scene_graph, visualizer, geometry, trail)


def SetView(meshcat: Meshcat, box: tuple[ArrayLike, ArrayLike], altitude: float) -> None:
    """Looks at a box from the south, from above, before a plain background.

    Args:
        meshcat: Is changed: camera, background, grid and axes.
        box: Lower and upper corner, (d,) each in m; only x and y count.
        altitude: Of the flight in m.

    Raises:
        ConfigurationError: if the box is empty.
        NonFiniteValueError: if a value is not finite.
    """
    lower, upper = PlaneBox(box)
    CheckFiniteParameter("altitude", altitude)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    for color in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", color, BACKGROUND_COLOR)
    (width, depth), middle = upper - lower, (lower + upper) / 2.0
    shift, distance = _Framing(width / 2.0, depth / 2.0)
    target: Any = np.array([middle[0], middle[1] - shift, altitude])
    away: Any = np.array([0.0, -math.cos(VIEW_ELEVATION), math.sin(VIEW_ELEVATION)])
    meshcat.SetCameraPose(target + distance * away, target)


def _Framing(half_width: float, half_depth: float) -> tuple[float, float]:
    """Returns where to look at to see a rectangle whole, and from how far, in m.

    A point y behind the target is seen at the slope y sin E / (distance + y cos E) over the
    middle of the picture.  The slopes of the far and of the near edge become k and -k, where
    k is the slope of the picture's border less a margin.

    Args:
        half_width: Half of its size to the sides in m.
        half_depth: Half of its size away from the viewer in m.

    Returns:
        How much nearer than the rectangle's middle the target is, and how far from there
        the camera.
    """
    s, c = math.sin(VIEW_ELEVATION), math.cos(VIEW_ELEVATION)
    k = VIEW_MARGIN * math.tan(FIELD_OF_VIEW / 2.0)
    shift = half_depth * k * c / s
    fits_up = half_depth * (s * s - k * k * c * c) / (k * s)
    # The near edge is the wider one.
    fits_across = half_width / (k * VIEW_ASPECT) + c * (half_depth - shift)
    return shift, max(fits_up, fits_across)


def SaveRecording(
    meshcat: Meshcat, path: str | os.PathLike[str], overwrite: bool = False
) -> Path:
    """Writes the scene and its recording as one page that opens without a network.

    Args:
        meshcat: Its recording, if there is one, is published.
        path: Of the HTML file, written whole or not at all.
        overwrite: Whether a file there may be replaced.

    Returns:
        The path.

    Raises:
        OutputExistsError: if the file exists and may not be replaced.
        ConfigurationError: if it cannot be written.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} already exists")
    meshcat.PublishRecording()
    page = meshcat.StaticHtml()
    try:
        # Beside the target, on the same file system: then a move is a rename.
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            temporary = Path(folder) / path.name
            temporary.write_text(page, encoding="utf-8")
            os.replace(temporary, path)
    except OSError as error:
        raise ConfigurationError(f"cannot write to {path}: {error.strerror}") from None
    return path
