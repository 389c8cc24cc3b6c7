"""Sliders in Meshcat that change a flight while it is simulated."""

from collections.abc import Callable, Iterator, Mapping
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, InputPort

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from systems.diagrams import FindPlant
from systems.disturbances import MEAN_WIND
from systems.guidance_loop import GuidanceLoop
from systems.supervision import ON_TOUR

STOP = "Stop"
"""The button that ends a flight."""

FASTEST = 4.0
"""A speed slider reaches so many times the speed at the start by default."""

SPEED_STEPS = 200
"""How many values a speed slider has."""

GAINS = {
    "velocity_gain": (0.5, 6.0, 0.1),
    "attitude_bandwidth": (6.0, 20.0, 0.5),
    "damping_ratio": (0.3, 1.5, 0.05),
}
"""Least value, greatest value and step of the gains that have a slider."""

STRONGEST_WIND = 5.0
"""m/s, on each axis, both ways."""

WIND_STEP = 0.1
"""m/s."""

DIGITS = 9
"""Digits after the point of what is set: a slider multiplies its step, which rounds."""

GAUGE_STEP = 0.001
"""The least change that a gauge shows; it ends at 1."""


class Control(NamedTuple):
    """What a slider sets.

    Attributes:
        name: The name of what is set, as that of a column in a log.
        unit: Its unit, or "".
        lower: The least value.
        upper: The greatest value.
        step: Between two values.
        Get: Returns the value in the Context of the whole diagram.
        Set: Sets it there.
    """

    name: str
    unit: str
    lower: float
    upper: float
    step: float
    Get: Callable[[Context], float]
    Set: Callable[[Context, float], None]

    @property
    def label(self) -> str:
        """What stands beside the slider."""
        words = self.name.replace("_", " ")
        return f"{words} [{self.unit}]" if self.unit else words


class Change(NamedTuple):
    """What was changed in flight.

    Attributes:
        time: When, in s.
        name: That of the `Control`.
        before: The value until then.
        after: The value from then on.
        unit: That of both.
    """

    time: float
    name: str
    before: float
    after: float
    unit: str

    def __str__(self) -> str:
        words = self.name.replace("_", " ")
        values = f"{self.before:g} -> {self.after:g}"
        return f"t = {self.time:.1f} s: {words} {values} {self.unit}".rstrip()


class LiveControls:
    """Sliders in Meshcat that change a flight while it is simulated, and a button to end it.

    There is a slider for what the diagram has.  Of each `GuidanceLoop` these are:

    - the speed of guidance, from zero on;
    - the gains of an `Se3Controller`, within `GAINS`;
    - the mean wind, where its plant flies in air that can move (see `Disturbance`);
    - of a supervisor on a network, the next edge, where that port is free: 0 is the route's;
    - of a supervisor on other paths, the wanted piece, from 1: 0 is the tour's.

    No system may write what belongs to another, so the sliders are read between two calls of
    `AdvanceTo`, as often as a flight is to answer::

        controls = LiveControls(meshcat, diagram, context)
        while not controls.stopped:
            controls.Apply(context)
            simulator.AdvanceTo(context.get_time() + 0.1)
        controls.Remove()

    A slider that nobody moves sets nothing: it may show a rounded value.

    Attributes:
        controls: What can be set, by the label of its slider.
        changes: What was changed so far, in the order of time.

    Args:
        meshcat: Gets the sliders; those of another flight are to be removed before.
        diagram: Has a `GuidanceLoop`; it is not a converted or cloned one.
        context: That of the whole diagram, with the values that the sliders start from.
        top_speed: The end of the speed sliders in m/s; None: `FASTEST` times each speed.
        gauges: What is shown below the sliders, by name: a share from 0 to 1, which is read
            from the Context of the whole diagram.

    Raises:
        ConfigurationError: if the diagram has no `GuidanceLoop`.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        diagram: Diagram,
        context: Context,
        *,
        top_speed: float | None = None,
        gauges: Mapping[str, Callable[[Context], float]] | None = None,
    ) -> None:
        found = [system for system in diagram.GetSystems() if isinstance(system, GuidanceLoop)]
        if not found:
            raise ConfigurationError("the diagram has no GuidanceLoop to control")
        controls = []
        for loop in found:
            prefix = f"{loop.get_name()}_" if len(found) > 1 else ""
            controls += [
                control._replace(name=prefix + control.name)
                for control in _ControlsOf(diagram, loop, context, top_speed)
            ]
        self._meshcat, self._gauges = meshcat, dict(gauges or {})
        self.controls = {control.label: control for control in controls}
        self.changes: list[Change] = []
        self._start = {control.name: control.Get(context) for control in controls}
        meshcat.AddButton(STOP)
        # What each slider showed when it was read last.
        self._shown = {
            label: meshcat.AddSlider(
                label, control.lower, control.upper, control.step, control.Get(context)
            )
            for label, control in self.controls.items()
        }
        for name in self._gauges:
            meshcat.AddSlider(name, 0.0, 1.0, GAUGE_STEP, 0.0)

    @property
    def stopped(self) -> bool:
        """Whether the button was pressed."""
        return self._meshcat.GetButtonClicks(STOP) > 0

    def Apply(self, context: Context) -> None:
        """Sets what sliders were moved to since the last call, and shows the gauges.

        Args:
            context: That of the whole diagram.
        """
        for label, control in self.controls.items():
            shown = self._meshcat.GetSliderValue(label)
            if shown != self._shown[label]:
                self._shown[label] = shown
                before, after = control.Get(context), round(shown, DIGITS)
                control.Set(context, after)
                change = Change(context.get_time(), control.name, before, after, control.unit)
                self.changes.append(change)
        for name, Read in self._gauges.items():
            self._meshcat.SetSliderValue(name, min(Read(context), 1.0))

    def Columns(self, times: FloatArray) -> dict[str, FloatArray]:
        """Returns what was set at the samples of a log, by the name of each control.

        As in the log itself, a change shows from the sample after it on.

        Args:
            times: When the samples were taken, (T,) in s.
        """
        columns = {name: np.full(len(times), start) for name, start in self._start.items()}
        for change in self.changes:
            columns[change.name][times > change.time] = change.after
        return columns

    def Remove(self) -> None:
        """Removes the button, the sliders and the gauges."""
        self._meshcat.DeleteButton(STOP)
        for name in (*self.controls, *self._gauges):
            self._meshcat.DeleteSlider(name)


def _ControlsOf(
    diagram: Diagram, loop: GuidanceLoop, context: Context, top_speed: float | None
) -> Iterator[Control]:
    """Yields what of one vehicle can be set."""
    if hasattr(loop.guidance, "SetSpeed"):
        yield _SpeedControl(loop.guidance, context, top_speed)
    if hasattr(loop.controller, "SetGains"):
        for name in GAINS:
            yield _GainControl(loop.controller, name, context)
    yield from _WindControls(FindPlant(diagram, loop), context)
    if loop.HasInputPort("next_edge"):
        port = loop.GetInputPort("next_edge")
        if (loop, port.get_index()) not in diagram.connection_map():
            yield _EdgeControl(loop, port)
    elif loop.supervisor is not None:
        yield _PieceControl(loop.supervisor)


def _SpeedControl(guidance: Any, context: Context, top_speed: float | None) -> Control:
    def Get(context: Context) -> float:
        return float(guidance.GetSpeed(guidance.GetMyContextFromRoot(context)))

    def Set(context: Context, speed: float) -> None:
        guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), speed)

    start = Get(context)
    top = max(FASTEST * start if top_speed is None else top_speed, start)
    step = _RoundStep(top / SPEED_STEPS)
    return Control("speed", "m/s", 0.0, step * math.ceil(top / step), step, Get, Set)


def _RoundStep(step: float) -> float:
    """Returns the power of ten that is next below a step; 0.01 for none."""
    return 10.0 ** math.floor(math.log10(step)) if step > 0.0 else 0.01


def _GainControl(controller: Any, name: str, context: Context) -> Control:
    def Get(context: Context) -> float:
        return float(
            getattr(controller.GetGains(controller.GetMyContextFromRoot(context)), name)
        )

    def Set(context: Context, gain: float) -> None:
        own = controller.GetMyMutableContextFromRoot(context)
        controller.SetGains(own, controller.GetGains(own)._replace(**{name: gain}))

    lower, upper, step = GAINS[name]
    start = Get(context)
    # Without a unit, for which there is no room beside the name.
    return Control(name, "", min(lower, start), max(upper, start), step, Get, Set)


def _WindControls(plant: Any, context: Context) -> Iterator[Control]:
    if not (isinstance(plant, Diagram) and plant.HasSubsystemNamed(MEAN_WIND)):
        return
    source: Any = plant.GetSubsystemByName(MEAN_WIND)
    for axis, name in enumerate("xyz"):

        def Get(context: Context, axis: int = axis) -> float:
            wind = source.get_source_value(source.GetMyContextFromRoot(context))
            return float(wind.GetAtIndex(axis))

        def Set(context: Context, speed: float, axis: int = axis) -> None:
            own = source.GetMyMutableContextFromRoot(context)
            source.get_mutable_source_value(own).SetAtIndex(axis, speed)

        most = max(STRONGEST_WIND, abs(Get(context)))
        yield Control(f"wind_{name}", "m/s", -most, most, WIND_STEP, Get, Set)


def _EdgeControl(loop: GuidanceLoop, port: InputPort) -> Control:
    def Get(context: Context) -> float:
        own = loop.GetMyContextFromRoot(context)
        asked: Any = port.Eval(own) if port.HasValue(own) else (0.0,)
        return float(asked[0])

    def Set(context: Context, edge: float) -> None:
        value: Any = [edge]
        port.FixValue(loop.GetMyMutableContextFromRoot(context), value)

    count = loop.supervisor.num_edges
    return Control("next_edge", "", -count, count, 1.0, Get, Set)


def _PieceControl(supervisor: Any) -> Control:
    def Get(context: Context) -> float:
        branch = supervisor.GetBranch(supervisor.GetMyContextFromRoot(context))
        return 0.0 if branch == ON_TOUR else branch + 1.0

    def Set(context: Context, piece: float) -> None:
        branch = ON_TOUR if piece == 0.0 else int(piece) - 1
        supervisor.SetBranch(supervisor.GetMyMutableContextFromRoot(context), branch)

    return Control("wanted_piece", "", 0.0, supervisor.num_branches, 1.0, Get, Set)
