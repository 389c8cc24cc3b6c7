"""The page of a flight that can be changed, in headless Chromium: the mouse moves sliders."""

import time

import numpy as np
import pytest

from systems import (
    Disturbance,
    DrawField,
    DrawWaypoints,
    LiveControls,
    MakeFlightDiagram,
    MakeMeshcat,
    MakeSimulator,
    SetHover,
    SetView,
)

from .test_meshcat_pages import ALTITUDE, BOX, START, RingField, ring

SPEED, WIND, GAUGE = "speed [m/s]", "wind x [m/s]", "velocity error"
# s; of the way from the page to the server.
PATIENCE = 60.0


def control(label):
    """The row of a slider or a button."""
    return (
        "[...document.querySelectorAll('.dg li.cr')].find(row => "
        f"row.querySelector('.property-name')?.textContent === '{label}')"
    )


class LiveFlight:
    """A flight along the ring and the page on which it is watched, with its controls open."""

    def __init__(self, open_page):
        self.meshcat = MakeMeshcat(port=0)
        self.diagram = MakeFlightDiagram(
            RingField(), speed=0.45, disturbance=Disturbance(), meshcat=self.meshcat
        )
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, START)
        DrawWaypoints(self.meshcat, ring(1.0), ALTITUDE)
        DrawField(self.meshcat, RingField(), BOX, ALTITUDE)
        SetView(self.meshcat, BOX, ALTITUDE)
        self.controls = LiveControls(
            *(self.meshcat, self.diagram, self.context),
            top_speed=2.0,
            gauges={GAUGE: lambda context: 0.1 * context.get_time()},
        )
        self.page = open_page(self.meshcat.web_url())
        self.page.wait_until(control(GAUGE))
        self.page.evaluate("document.querySelector('.dg .close-button').click()")
        self.page.wait_until(f"{control(GAUGE)}.getBoundingClientRect().width > 100")

    def until(self, end):
        """Flies on, and returns the state."""
        while self.context.get_time() < end - 1e-9:
            self.controls.Apply(self.context)
            self.simulator.AdvanceTo(self.context.get_time() + 0.1)
        self.meshcat.Flush()
        return self.diagram.GetOutputPort("state").Eval(self.context)

    def move(self, label, value, lower, upper):
        """Drags a slider with the mouse, and waits until the server knows."""
        before = self.meshcat.GetSliderValue(label)
        box = self.page.evaluate(
            f"{control(label)}.querySelector('.slider').getBoundingClientRect().toJSON()"
        )
        y = box["y"] + box["height"] / 2
        at = [
            box["x"] + box["width"] * (number - lower) / (upper - lower)
            for number in (before, value)
        ]
        self.page.drag((at[0], y), (at[1], y))
        self.wait(lambda: self.meshcat.GetSliderValue(label) != before)

    def wait(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, "the page did not tell its server"
            time.sleep(0.01)

    def shown(self, label):
        """The number beside a slider in the page."""
        return float(self.page.evaluate(f"{control(label)}.querySelector('input').value"))


@pytest.fixture(scope="module")
def live(open_page):
    return LiveFlight(open_page)


def test_sliders_that_are_moved_in_the_page_change_the_flight(live, tmp_path):
    state = live.until(3.0)
    # The air takes drag / (mass velocity_gain) of the speed.
    slow = 1.0 - 0.1 / (0.46 * 3.0)
    assert np.linalg.norm(state[6:9]) == pytest.approx(0.45 * slow, abs=0.01)
    live.move(SPEED, 0.9, 0.0, 2.0)
    faster = live.until(6.0)
    # A pixel of the slider is 0.02 m/s.
    assert np.linalg.norm(faster[6:9]) == pytest.approx(0.9 * slow, abs=0.04)
    in_still_air = np.hypot(*faster[:2]) - 1.0
    live.move(WIND, 4.0, -5.0, 5.0)
    blown = live.until(9.0)
    assert abs(np.hypot(*blown[:2]) - 1.0) > 10 * abs(in_still_air)
    assert {change.name for change in live.controls.changes} == {"speed", "wind_x"}
    live.page.wait_until(f"{control(GAUGE)}.querySelector('input').value === '0.89'")
    assert live.shown(SPEED) == live.meshcat.GetSliderValue(SPEED)
    _, png = live.page.screenshot()
    (tmp_path / "screenshot.png").write_bytes(png)  # For whoever wants to look.
    assert live.page.complaints() == []


def test_the_button_in_the_page_stops(live):
    assert not live.controls.stopped
    live.page.evaluate(f"{control('Stop')}.querySelector('.property-name').click()")
    live.wait(lambda: live.controls.stopped)
    live.controls.Remove()
    live.meshcat.Flush()
    live.page.wait_until(f"!{control('Stop')} && !{control(SPEED)}")
