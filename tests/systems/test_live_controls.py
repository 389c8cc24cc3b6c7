"""Sliders that change a flight: against the same changes made by hand, and by what flies."""

import numpy as np
from pydrake.systems.framework import DiagramBuilder
import pytest

from systems import (
    AddGuidance,
    BranchAlong,
    BranchSupervisor,
    Change,
    Disturbance,
    LiveControls,
    MakeFlightDiagram,
    MakeMeshcat,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)
from systems.live_controls import STOP, STRONGEST_WIND

from .flying import RINGS, TWO_RINGS, check_refusal

GAINS = ["velocity gain", "attitude bandwidth", "damping ratio"]
WIND = ["wind x [m/s]", "wind y [m/s]", "wind z [m/s]"]
SPEED = "speed [m/s]"
# What a browser sends when the button is pressed.
PRESSED = b"\x82\xa4type\xa6button\xa4name\xa4Stop"


@pytest.fixture(scope="module")
def server():
    return MakeMeshcat(port=0)


@pytest.fixture
def meshcat(server):
    server.DeleteAddedControls()
    return server


class Flight:
    """A flight with sliders, if there is a Meshcat; `looks` are 0.1 s apart."""

    def __init__(self, field, meshcat=None, start=(1.1, 0.0, 1.0), heading=None, **options):
        self.diagram = MakeFlightDiagram(field, **options)
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, start)
        self.loop = self.diagram.GetSubsystemByName("guidance_loop")
        self.looks = 0
        if heading is not None:
            self.loop.guidance.SetHeading(self.own(self.loop.guidance), heading)
        if meshcat is not None:
            self.controls = LiveControls(meshcat, self.diagram, self.context)

    def own(self, system):
        return system.GetMyMutableContextFromRoot(self.context)

    def until(self, time):
        while self.looks < round(10 * time):
            if hasattr(self, "controls"):
                self.controls.Apply(self.context)
            self.looks += 1
            self.simulator.AdvanceTo(0.1 * self.looks)
        return self.diagram.GetOutputPort("state").Eval(self.context)

    def set_by_hand(self, name, value):
        guidance, controller = self.loop.guidance, self.loop.controller
        if name == SPEED:
            guidance.SetSpeed(self.own(guidance), value)
        elif name in GAINS:
            gains = controller.GetGains(self.own(controller))
            changed = gains._replace(**{name.replace(" ", "_"): value})
            controller.SetGains(self.own(controller), changed)
        else:
            source = self.diagram.GetSubsystemByName("plant").GetSubsystemByName("mean_wind")
            values = source.get_mutable_source_value(self.own(source))
            values.SetAtIndex(WIND.index(name), value)


AIR = Disturbance(wind=(0.5, 0.0, 0.0))


def test_there_is_a_slider_for_what_the_diagram_has(circle_field, meshcat):
    flight = Flight(circle_field, meshcat, speed=0.6)
    assert [*meshcat.GetSliderNames()] == sorted([SPEED, *GAINS])
    assert meshcat.GetSliderValue(SPEED) == 0.6
    assert meshcat.GetSliderValue("attitude bandwidth") == 12.0
    assert meshcat.GetButtonNames() == [STOP]
    flight.controls.Remove()
    assert not [*meshcat.GetSliderNames(), *meshcat.GetButtonNames()]
    Flight(circle_field, meshcat, disturbance=Disturbance(wind=(7.0, 0.0, 0.0)))
    assert sorted(meshcat.GetSliderNames()) == sorted([SPEED, *GAINS, *WIND])
    # The wind that is there already can be kept, and turned round.
    assert meshcat.SetSliderValue("wind x [m/s]", -9.0) == -7.0
    assert meshcat.SetSliderValue("wind y [m/s]", 9.0) == STRONGEST_WIND


CHANGES = [
    *((SPEED, 0.8), (SPEED, 0.0)),
    *(("velocity gain", 1.0), ("attitude bandwidth", 8.0), ("damping ratio", 1.1)),
    *((name, 5.0) for name in WIND),
]


@pytest.mark.parametrize(("name", "value"), CHANGES)
def test_a_moved_slider_is_the_same_as_the_change_by_hand(circle_field, meshcat, name, value):
    moved, by_hand, left_alone = (
        Flight(circle_field, viewer, disturbance=AIR) for viewer in (meshcat, None, None)
    )
    for flight in (moved, by_hand, left_alone):
        flight.until(1.0)
    meshcat.SetSliderValue(name, value)
    by_hand.set_by_hand(name, value)
    state = moved.until(2.0)
    np.testing.assert_array_equal(state, by_hand.until(2.0))
    assert np.abs(state - left_alone.until(2.0)).max() > 1e-4
    before = {SPEED: 0.45, "wind x [m/s]": 0.5, **dict.fromkeys(WIND[1:], 0.0)}
    before |= dict(zip(GAINS, (3.0, 12.0, 0.7), strict=True))
    (change,) = moved.controls.changes
    assert change[2:4] == (before[name], value)
    assert change.time == pytest.approx(1.0)
    assert str(change).startswith(f"t = 1.0 s: {name.split(' [')[0]} {before[name]:g} -> ")


def test_the_vehicle_flies_at_the_speed_of_the_slider(circle_field, meshcat):
    flight = Flight(circle_field, meshcat)
    for time, speed in ((3.0, 0.45), (6.0, 0.8), (9.0, 0.0)):
        meshcat.SetSliderValue(SPEED, speed)
        velocity = flight.until(time)[6:9]
        assert np.linalg.norm(velocity) == pytest.approx(speed, abs=0.01)


def test_sliders_that_nobody_moves_change_nothing(circle_field, meshcat):
    # No multiple of the slider's step, which shows a rounded value.
    options = {"speed": 0.4567, "disturbance": AIR}
    watched, alone = Flight(circle_field, meshcat, **options), Flight(circle_field, **options)
    np.testing.assert_array_equal(watched.until(2.0), alone.until(2.0))
    assert meshcat.GetSliderValue(SPEED) != 0.4567
    assert watched.controls.changes == []


def test_each_of_several_vehicles_has_its_sliders(circle_field, meshcat):
    builder = DiagramBuilder()
    for name in ("first", "second"):
        plant = builder.AddNamedSystem(name, QuadrotorParameters().MakePlant())
        AddGuidance(builder, circle_field, plant, name=f"{name}_loop")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    controls = LiveControls(meshcat, diagram, context)
    meshcat.SetSliderValue("second loop speed [m/s]", 1.0)
    controls.Apply(context)
    assert [change.name for change in controls.changes] == ["second_loop_speed"]
    for name, speed in (("first", 0.45), ("second", 1.0)):
        guidance = diagram.GetSubsystemByName(f"{name}_loop").guidance
        assert guidance.GetSpeed(guidance.GetMyContextFromRoot(context)) == speed


def test_the_next_edge_of_a_route_is_turned_into(tee_field, meshcat):
    # From the left arm of the T on; straight on would be the right one.
    network, edges = tee_field.network, {}
    for number, edge in enumerate(network.edges, start=1):
        begin, end = (network.nodes[node].place for node in edge.nodes)
        arm = (
            "below"
            if min(begin[1], end[1]) < 0
            else "left"
            if begin[0] + end[0] < 0
            else "right"
        )
        # Towards the junction, in the middle of the bar.
        edges[arm] = number if tuple(np.round(end, 1)) == (0.0, 1.5) else -number
    branch = BranchAlong(tee_field, f"{edges['left']},{-edges['right']}")
    into_stem = -edges["below"]
    flown = []
    for edge in (0, into_stem):
        meshcat.DeleteAddedControls()
        supervisor = BranchSupervisor(tee_field, (branch,))
        flight = Flight(
            *(tee_field, meshcat, (-1.0, 1.5, 1.0), [1.0, 0.0]),
            speed=1.0,
            supervisor=supervisor,
        )
        meshcat.SetSliderValue("next edge", edge)
        flown.append(flight.until(3.0)[:2])
    assert flown[0][0] > 1.0
    assert flown[1][1] < 0.5
    assert [change.after for change in flight.controls.changes] == [into_stem]


def test_the_wanted_piece_is_flown_to_and_the_tour_goes_on(meshcat):
    supervisor = BranchSupervisor(TWO_RINGS, RINGS, (0,))
    flight = Flight(TWO_RINGS, meshcat, supervisor=supervisor, speed=0.8)
    assert meshcat.SetSliderValue("wanted piece", 9) == 2
    for piece, radius in ((2, 2.0), (0, 1.0)):
        meshcat.SetSliderValue("wanted piece", piece)
        assert np.hypot(*flight.until(flight.looks / 10 + 12.0)[:2]) == pytest.approx(
            radius, abs=0.02
        )


def test_the_columns_tell_what_was_set_at_each_sample(circle_field, meshcat):
    flight = Flight(circle_field, meshcat, log_period=0.01)
    flight.until(0.3)
    meshcat.SetSliderValue(SPEED, 0.8)
    flight.until(0.5)
    log = flight.diagram.GetSubsystemByName("velocity_command_log").FindLog(flight.context)
    times = log.sample_times()
    columns = flight.controls.Columns(times)
    assert set(columns) == {"speed", *(name.replace(" ", "_") for name in GAINS)}
    np.testing.assert_array_equal(columns["damping_ratio"], 0.7)
    # The command over the plane has the length of the speed, but for the first samples.
    commanded = np.linalg.norm(log.data()[:2], axis=0)
    np.testing.assert_allclose(columns["speed"][5:], commanded[5:], atol=1e-9)


def test_the_button_stops(circle_field, meshcat):
    controls = Flight(circle_field, meshcat).controls
    assert not controls.stopped
    meshcat._InjectWebsocketMessage(PRESSED)
    assert controls.stopped
    controls.Remove()
    # The next flight is not stopped by the button of this one.
    assert not Flight(circle_field, meshcat).controls.stopped


def test_gauges_show_shares_up_to_their_end(circle_field, meshcat):
    flight = Flight(circle_field)
    gauges = {"share": lambda context: 0.1 + context.get_time(), "far": lambda context: np.inf}
    flight.controls = LiveControls(meshcat, flight.diagram, flight.context, gauges=gauges)
    flight.until(0.3)
    assert meshcat.GetSliderValue("share") == pytest.approx(0.3)
    assert meshcat.GetSliderValue("far") == 1.0
    # A gauge sets nothing.
    meshcat.SetSliderValue("share", 0.9)
    flight.until(0.5)
    assert meshcat.GetSliderValue("share") == pytest.approx(0.5)
    assert flight.controls.changes == []


def test_a_change_says_in_words_what_was_changed():
    assert str(Change(3.2, "speed", 0.45, 0.8, "m/s")) == "t = 3.2 s: speed 0.45 -> 0.8 m/s"
    assert str(Change(4.0, "next_edge", 0.0, -2.0, "")) == "t = 4.0 s: next edge 0 -> -2"


def test_a_diagram_without_a_loop_is_refused(meshcat):
    builder = DiagramBuilder()
    builder.AddSystem(QuadrotorParameters().MakePlant())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    check_refusal(lambda: LiveControls(meshcat, diagram, context), "no GuidanceLoop to control")
    assert not meshcat.GetSliderNames()
