"""Flights that are watched: against flights that are not, and against the frames' own times."""

import os
from pathlib import Path
import socket

import numpy as np
from pydrake.geometry import Box, GeometryInstance, MakePhongIllustrationProperties
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError, OutputExistsError
from systems import AddGuidance, MakeSimulator, QuadrotorParameters, SetHover
from systems.visualization import (
    FIELD_OF_VIEW,
    PUBLISH_PERIOD,
    VIEW_ASPECT,
    VIEW_MARGIN,
    AddFlightVisualization,
    MakeMeshcat,
    SaveRecording,
    SetView,
)

PARAMETERS = QuadrotorParameters()


@pytest.fixture(scope="module")
def meshcat():
    return MakeMeshcat(port=0)


@pytest.fixture
def clean_meshcat(meshcat):
    """The same server with an empty scene and no recording."""
    meshcat.Delete()
    meshcat.DeleteRecording()
    return meshcat


class Watched:
    """A flight of the circle field; with a Meshcat it is watched there."""

    def __init__(self, field, meshcat=None, prepare=lambda scene_graph: None, **options):
        builder = DiagramBuilder()
        plant = builder.AddNamedSystem("plant", PARAMETERS.MakePlant())
        AddGuidance(builder, field, plant, PARAMETERS, speed=0.8, altitude=1.0)
        if meshcat is not None:
            self.parts = AddFlightVisualization(
                builder, plant.GetOutputPort("state"), PARAMETERS, meshcat, **options
            )
            prepare(self.parts.scene_graph)
        self.diagram = builder.Build()
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, (1.3, 0.0, 1.0))

    def state(self):
        return self.context.get_continuous_state_vector().CopyToVector()


@pytest.mark.parametrize("period", [PUBLISH_PERIOD, 1.0 / 64.0])
def test_a_recording_has_its_own_frame_for_each_time_of_publishing(
    circle_field, clean_meshcat, period
):
    flight = Watched(circle_field, clean_meshcat, publish_period=period)
    animation = flight.parts.visualizer.StartRecording()
    assert animation.frames_per_second() == 1.0 / period
    flight.simulator.Initialize()
    # A minute; the times of publishing are these products.
    frames = [animation.frame(k * period) for k in range(round(60.0 / period))]
    assert frames == list(range(len(frames)))


def test_a_period_that_loses_frames_is_refused(circle_field, clean_meshcat):
    for period in (0.02, 0.04, 1.0 / 30.0, 0.0, -0.5, np.nan, np.inf):
        with pytest.raises(ConfigurationError, match="publish_period must be a power of two"):
            Watched(circle_field, clean_meshcat, publish_period=period)


def test_the_vehicle_its_trail_and_the_users_geometry_are_in_the_scene(
    circle_field, clean_meshcat
):
    def add_pillar(scene_graph):
        source_id = scene_graph.RegisterSource("mine")
        pillar = GeometryInstance(RigidTransform(), Box(0.1, 0.1, 2.0), "pillar")
        pillar.set_illustration_properties(MakePhongIllustrationProperties([1, 0, 0, 1]))
        scene_graph.RegisterAnchoredGeometry(source_id, pillar)

    flight = Watched(circle_field, clean_meshcat, add_pillar)
    flight.simulator.AdvanceTo(0.3)
    for path in ("quadrotor/propeller_0", "pillar"):
        assert clean_meshcat.HasPath(f"/drake/visualizer/{path}")
    assert clean_meshcat.HasPath("/trail")
    assert sorted(flight.parts._fields) == ["geometry", "scene_graph", "trail", "visualizer"]
    names = {system.get_name() for system in flight.diagram.GetSystems()}
    assert names >= {"scene_graph", "quadrotor_geometry", "meshcat_visualizer", "trail"}


def test_vehicles_are_shown_beside_each_other(circle_field, clean_meshcat):
    builder, shown = DiagramBuilder(), None
    for name in ("first", "second"):
        plant = builder.AddNamedSystem(name, PARAMETERS.MakePlant())
        AddGuidance(builder, circle_field, plant, PARAMETERS, name=f"{name}_loop")
        port = plant.GetOutputPort("state")
        options = {"name": name, "beside": shown}
        shown = AddFlightVisualization(builder, port, PARAMETERS, clean_meshcat, **options)
    with pytest.raises(ConfigurationError, match="'second_geometry' already"):
        AddFlightVisualization(builder, port, PARAMETERS, clean_meshcat, **options)
    with pytest.raises(ConfigurationError, match="'scene_graph' already: show another"):
        AddFlightVisualization(builder, port, PARAMETERS, clean_meshcat, name="third")
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    for name, x in (("first", 1.3), ("second", 0.8)):
        SetHover(diagram, simulator.get_mutable_context(), (x, 0.0, 1.0), f"{name}_loop")
    simulator.AdvanceTo(0.3)
    for path in ("first/propeller_0", "second/propeller_0"):
        assert clean_meshcat.HasPath(f"/drake/visualizer/{path}")
    assert clean_meshcat.HasPath("/trail")
    assert clean_meshcat.HasPath("/second_trail")


# The view.


class Viewer:
    """Stands for Meshcat, and keeps where it looks."""

    def SetProperty(self, path, name, value):  # noqa: N802
        pass

    def SetCameraPose(self, camera, target):  # noqa: N802
        self.camera, self.target = camera, target

    def project(self, points):
        """Returns the places of points (n, 3) in the picture, up to 1 and VIEW_ASPECT."""
        forward = self.target - self.camera
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        depth = (points - self.camera) @ forward
        assert (depth > 0.0).all()
        across, above = (points - self.camera) @ right, (points - self.camera) @ up
        scale = depth[:, None] * np.tan(FIELD_OF_VIEW / 2.0)
        return np.column_stack((across, above)) / scale


@pytest.mark.parametrize(
    "box",
    [
        ([-1.0, -1.0], [1.0, 1.0]),
        ([3.0, -8.0], [3.5, 4.0]),
        ([-20.0, 100.0], [10.0, 101.0]),
        ([0.0, 0.0, -5.0], [1.0, 0.8, 5.0]),
        ([-0.1, -1.0], [0.1, 1.0]),
    ],
)
def test_the_view_just_shows_the_box(box):
    viewer, altitude = Viewer(), 1.5
    SetView(viewer, box, altitude)
    (left, near), (right, far) = np.array(box)[:, :2]
    corners = np.array([[x, y, altitude] for x in (left, right) for y in (near, far)])
    seen = viewer.project(corners) / [VIEW_ASPECT, 1.0]
    # Whole, and one border or the other is reached.
    assert np.abs(seen).max() == pytest.approx(VIEW_MARGIN)
    # From the south, in the middle from side to side, with x to the right and y up.
    np.testing.assert_allclose(seen[:2, 0], -seen[2:, 0])
    assert seen[0, 0] < seen[2, 0]
    assert seen[0, 1] < seen[1, 1]
    if right - left < far - near:
        # Where the height counts, as full above as below.
        np.testing.assert_allclose(seen[:2, 1], [-VIEW_MARGIN, VIEW_MARGIN])


def test_a_view_of_what_is_not_finite_is_refused():
    with pytest.raises(NonFiniteValueError, match="box"):
        SetView(Viewer(), ([0.0, 0.0], [np.inf, 1.0]), 1.0)
    with pytest.raises(ConfigurationError, match="altitude"):
        SetView(Viewer(), ([0.0, 0.0], [1.0, 1.0]), np.nan)


# The page.


class Broken:
    """Stands for a Meshcat whose page cannot be written: UTF-8 has no lone surrogates."""

    def PublishRecording(self):  # noqa: N802
        pass

    def StaticHtml(self):  # noqa: N802
        return "half a page" + "\ud800"


def test_a_page_is_written_whole_or_not_at_all_and_replaces_another_only_on_demand(
    meshcat, tmp_path
):
    path = tmp_path / "flight.html"
    with pytest.raises(UnicodeEncodeError):
        SaveRecording(Broken(), path)
    assert os.listdir(tmp_path) == []
    path.write_text("precious")
    with pytest.raises(OutputExistsError, match=r"flight\.html already exists"):
        SaveRecording(meshcat, path)
    with pytest.raises(UnicodeEncodeError):
        SaveRecording(Broken(), path, overwrite=True)
    assert path.read_text() == "precious"
    assert SaveRecording(meshcat, str(path), overwrite=True) == path
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert text.rstrip().endswith("</html>")
    assert os.listdir(tmp_path) == ["flight.html"]


@pytest.mark.parametrize("place", ["missing/flight.html", "file/flight.html", "folder"])
def test_a_page_that_cannot_be_there_is_refused(meshcat, tmp_path, place):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "inside").touch()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ConfigurationError, match=f"cannot write to .*{Path(place).name}"):
        SaveRecording(meshcat, tmp_path / place, overwrite=True)
    assert sorted(tmp_path.rglob("*")) == before


# The server.


def test_only_this_machine_is_served(meshcat):
    assert meshcat.web_url() == f"http://localhost:{meshcat.port()}"
    # Of all addresses, which "*" would take, this is one that no name leads to.
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", meshcat.port()))
    socket.create_connection(("localhost", meshcat.port())).close()


def test_a_port_that_cannot_be_had_is_refused(meshcat):
    for port in (-1, 1, 80, 65536, 80000):
        with pytest.raises(ConfigurationError, match=f"port must be .* got {port}"):
            MakeMeshcat(port=port)
    taken = meshcat.port()
    with pytest.raises(ConfigurationError, match=f"cannot listen on localhost:{taken}"):
        MakeMeshcat(port=taken)
    # A server ends with its last user.
    other = MakeMeshcat(port=0)
    port = other.port()
    del other
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", port))
