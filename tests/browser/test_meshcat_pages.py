"""What a reader sees of a flight: the saved page and the live one, in headless Chromium."""

from itertools import pairwise

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
import pytest
from scipy.spatial.transform import Rotation

from systems import AddGuidance, MakeSimulator, QuadrotorParameters, SetHover
from systems.scene_drawing import FIELD_ARROWS, DrawField, DrawTube, DrawWaypoints
from systems.visualization import (
    PUBLISH_PERIOD,
    AddFlightVisualization,
    MakeMeshcat,
    SaveRecording,
    SetView,
)

ALTITUDE = 1.0
DURATION = 4.0
START = (1.3, 0.0, ALTITUDE)
BOX = ([-1.6, -1.6], [1.6, 1.6])
QUADROTOR = "viewer.scene.getObjectByName('quadrotor')"
DRAWN = ("field", "trail", "tube", "waypoints")
VEHICLE = ("body", "arm_x", "arm_y", *(f"propeller_{n}" for n in range(4)))
SHOWN = " && ".join(f"viewer.scene_tree.children.{name}" for name in ("drake", *DRAWN))

# Of 1280 x 720 pixels, how many each part of the scene has to change.
SEEN = {
    "quadrotor": 2000,
    "propeller_0": 200,
    "field": 10000,
    "trail": 200,
    "tube": 1000,
    "waypoints": 500,
}

# Every object with a geometry: the name of the node that holds it, its type, and how many
# vertices it has.
GEOMETRIES = """(() => {
    const found = [];
    viewer.scene.traverse(object => {
        // What newer versions of Meshcat have in the scene itself is not ours.
        if (object.geometry?.attributes.position && object.parent.name !== 'Scene')
            found.push([object.parent.name, object.type,
                        object.geometry.attributes.position.count]);
    });
    return found;
})()"""

TRACKS = """viewer.animator.actions.map(action => [
    action._localRoot.name,
    Object.fromEntries(action._clip.tracks.map(
        track => [track.name, [Array.from(track.times), Array.from(track.values)]]))])"""


class RingField:
    """A field around the unit circle, counter-clockwise, of unit length but in its middle."""

    dim = 2

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        x = np.asarray(x)
        inside = 1.0 - np.sum(x * x, axis=-1, keepdims=True)
        turn = np.array([[0.0, -1.0], [1.0, 0.0]])
        f = x @ turn.T + 2.0 * inside * x
        J_f = turn + 2.0 * inside[..., np.newaxis] * np.eye(2)
        J_f = J_f - 4.0 * x[..., :, np.newaxis] * x[..., np.newaxis, :]
        size = np.maximum(np.linalg.norm(f, axis=-1, keepdims=True), 1e-9)
        m = f / size
        across = np.eye(2) - m[..., :, np.newaxis] * m[..., np.newaxis, :]
        return m, across @ J_f / size[..., np.newaxis]


def ring(radius, count=100):
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    return radius * np.column_stack((np.cos(angle), np.sin(angle)))


class Show:
    """A flight along the ring, in a Meshcat with everything that can be drawn."""

    def __init__(self):
        parameters = QuadrotorParameters()
        self.meshcat = MakeMeshcat(port=0)
        builder = DiagramBuilder()
        plant = builder.AddNamedSystem("plant", parameters.MakePlant())
        AddGuidance(builder, RingField(), plant, parameters, speed=0.8, altitude=ALTITUDE)
        state = plant.GetOutputPort("state")
        parts = AddFlightVisualization(builder, state, parameters, self.meshcat)
        self.visualizer, self.trail = parts.visualizer, parts.trail
        self.log = LogVectorOutput(state, builder, PUBLISH_PERIOD)
        self.diagram = builder.Build()
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, START)
        DrawWaypoints(self.meshcat, ring(1.0), ALTITUDE)
        DrawField(self.meshcat, RingField(), BOX, ALTITUDE)
        DrawTube(self.meshcat, [ring(0.85), ring(1.15)], ALTITUDE)
        SetView(self.meshcat, BOX, ALTITUDE)

    def fly(self, end):
        self.simulator.AdvanceTo(end)
        self.trail.DrawToEnd(self.context)
        self.meshcat.Flush()

    def logged(self):
        """The times (T,) and states (T, 12) at the times of publishing."""
        log = self.log.FindLog(self.context)
        return log.sample_times(), log.data().T


@pytest.fixture(scope="module")
def recorded():
    """A flight that was recorded from its start to its end."""
    show = Show()
    show.visualizer.StartRecording()
    show.fly(DURATION)
    return show


@pytest.fixture(scope="module")
def saved(recorded, open_page, tmp_path_factory):
    """The page of the recorded flight, open from its file and standing at its start."""
    path = SaveRecording(recorded.meshcat, tmp_path_factory.mktemp("saved") / "flight.html")
    page = open_page(path.as_uri())
    page.wait_until(f"{SHOWN} && viewer.animator.actions.length")
    page.evaluate("viewer.animator.pause()")
    return page


@pytest.fixture(scope="module")
def live(open_page):
    """A flight that is watched, and the page on which it is."""
    show = Show()
    show.fly(1.0)
    page = open_page(show.meshcat.web_url())
    page.wait_until(SHOWN)
    return show, page


def assert_everything_is_drawn_once(page):
    found = page.evaluate(GEOMETRIES)
    counts = {name: (kind, count) for name, kind, count in found}
    assert counts["field"] == ("LineSegments", 6 * FIELD_ARROWS**2)
    assert counts["tube"] == ("LineSegments", 2 * 2 * 99)
    assert counts["waypoints"] == ("Points", 100)
    assert counts["trail"][0] == "Mesh"
    # The trail is three ribbons: six vertices a point, and at least one point a frame.
    assert counts["trail"][1] >= 6 * 32
    for part in VEHICLE:
        assert counts[part][0] == "Mesh"
        assert counts[part][1] > 0
    assert len(found) == len(counts), f"each is one object: {found}"
    assert set(counts) <= {"Grid", "Axes", *DRAWN, *VEHICLE}
    for hidden in ("Grid", "Axes"):
        assert not page.evaluate(f"viewer.scene_tree.children.{hidden}.object.visible")


def assert_everything_is_seen(page, tmp_path):
    picture, png = page.screenshot()
    (tmp_path / "screenshot.png").write_bytes(png)  # For whoever wants to look.
    # Nothing is cut off at the sides or below; above there are Meshcat's own controls.
    for border in (picture[60:, 0], picture[60:, -1], picture[-1]):
        np.testing.assert_array_equal(border, 1.0)
    for name, pixels in SEEN.items():
        node = f"viewer.scene.getObjectByName('{name}')"
        page.evaluate(f"{node}.visible = false; viewer.set_dirty()")
        without, _ = page.screenshot()
        page.evaluate(f"{node}.visible = true; viewer.set_dirty()")
        changed = np.abs(picture - without).max(axis=-1) > 0.1
        assert changed.sum() > pixels, name


def test_the_saved_page_needs_no_network_and_does_not_complain(saved):
    requests = saved.requests()
    assert requests[0].startswith("file:///")
    assert {url.split(":")[0] for url in requests} <= {"file", "data", "blob"}
    assert sum(url.startswith("file:") for url in requests) == 1
    assert saved.complaints() == []


def test_the_saved_page_shows_everything(saved, tmp_path):
    assert_everything_is_drawn_once(saved)
    assert_everything_is_seen(saved, tmp_path)


def test_the_recording_has_each_frame_once_and_the_vehicle_where_it_flew(saved, recorded):
    ((name, tracks),) = saved.evaluate(TRACKS)
    assert name == "quadrotor"
    times, states = recorded.logged()
    np.testing.assert_array_equal(times, PUBLISH_PERIOD * np.arange(129))
    frames, positions = tracks[".position"]
    np.testing.assert_array_equal(frames, times)
    # Browsers draw in single precision.
    np.testing.assert_allclose(np.reshape(positions, (-1, 3)), states[:, :3], atol=1e-6)
    frames, quaternions = tracks[".quaternion"]
    np.testing.assert_array_equal(frames, times)
    R_WB = Rotation.from_quat(np.reshape(quaternions, (-1, 4))).as_matrix()
    expected = Rotation.from_euler("xyz", states[:, 3:6]).as_matrix()
    np.testing.assert_allclose(R_WB, expected, atol=1e-6)


def test_the_vehicle_moves_with_the_time_of_the_recording(saved, recorded):
    _, states = recorded.logged()
    pictures = []
    for frame in (0, 60, 128):
        saved.evaluate(f"viewer.animator.seek({frame * PUBLISH_PERIOD})")
        position = saved.evaluate(f"{QUADROTOR}.position.toArray()")
        np.testing.assert_allclose(position, states[frame, :3], atol=1e-6)
        pictures.append(saved.screenshot()[0])
    for one, other in pairwise(pictures):
        assert np.abs(one - other).max() > 0.3


def test_the_live_page_shows_everything_and_follows_the_flight(live, tmp_path):
    show, page = live
    assert_everything_is_drawn_once(page)
    assert_everything_is_seen(page, tmp_path)
    length = f"{GEOMETRIES}.find(([name]) => name === 'trail')[2]"
    before = page.evaluate(length)
    show.fly(2.5)
    p_WB = show.context.get_continuous_state_vector().CopyToVector()[:3]
    x, y, z = p_WB.tolist()
    page.wait_until(f"{QUADROTOR}.position.distanceTo({{x: {x}, y: {y}, z: {z}}}) < 1e-6")
    page.wait_until(f"{length} > {before}")
    # It talks to its server only, and does not complain.
    server = show.meshcat.web_url()
    requests = [url for url in page.requests() if not url.startswith(("data:", "blob:"))]
    assert show.meshcat.ws_url().rstrip("/") in {url.rstrip("/") for url in requests}
    for url in requests:
        assert url.replace("ws:", "http:").startswith(server)
    assert page.complaints() == []


def test_a_page_without_a_recording_opens_too(open_page, tmp_path):
    meshcat = MakeMeshcat(port=0)
    DrawWaypoints(meshcat, ring(1.0), ALTITUDE)
    page = open_page(SaveRecording(meshcat, tmp_path / "still.html").as_uri())
    page.wait_until("viewer.scene_tree.children.waypoints")
    assert ["waypoints", "Points", 100] in page.evaluate(GEOMETRIES)
    assert page.complaints() == []
