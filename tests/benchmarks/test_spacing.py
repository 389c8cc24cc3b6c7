"""Several vehicles in one diagram: how fast, each as alone, and spaced along one path.

Vehicles start close to each other and are spaced by their speeds, on a learned ring and on an
eight that is driven straight over its crossing.
"""

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
import pytest

import sgvf_drake as sgvf
from sgvf_drake import plotting
from sgvf_drake.clouds import PointCloud
from sgvf_drake.metrics import least_separation
from systems import (
    AddGuidance,
    AddSpacing,
    MakeBranches,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)
from tests.networks import SHAPES

from .measuring import best_of, trained

pytestmark = pytest.mark.benchmark

SIMULATED_S, REPEATS = 10.0, 5
# Share of a gap.
SETTLED = 0.02
# Of the length, between neighbours at the start.
CROWDED = 0.04
# On both sides of the crossing of the eight, no two of eight vehicles are half a length apart.
NO_MEETING = (2, 2, 2, 3, 2, 2, 2, 1)
# Greatest speed in m/s, and seconds.
COURSES = {"ring": (0.6, 50.0), "eight": (1.0, 120.0)}
CASES = {
    "ring": (("3", (1,) * 3), ("8", (1,) * 8)),
    "eight": (("3", (1,) * 3), ("8", (1,) * 8), ("8, no meeting", NO_MEETING)),
}


class Squad:
    """Vehicles 0, 1.. that follow one field, each with a loop and a log of its own."""

    def __init__(self, field, count, speed=0.45):
        self.builder, self.loops, self.logs = DiagramBuilder(), [], []
        for i in range(count):
            plant = self.builder.AddNamedSystem(
                f"vehicle {i}", QuadrotorParameters().MakePlant()
            )
            loop = AddGuidance(self.builder, field, plant, name=f"loop {i}", speed=speed)
            self.loops.append(loop)
            self.logs.append(LogVectorOutput(plant.GetOutputPort("state"), self.builder, 0.01))

    def build(self):
        self.diagram = self.builder.Build()
        return self

    def fly(self, starts, headings, duration):
        """Returns the states (T, n, 12)."""
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        for i, (start, loop) in enumerate(zip(starts, self.loops, strict=True)):
            SetHover(self.diagram, self.context, start, f"loop {i}")
            if loop.guidance.HasOutputPort("heading"):
                own = loop.guidance.GetMyMutableContextFromRoot(self.context)
                loop.guidance.SetHeading(own, headings[i])
        self.simulator.AdvanceTo(duration)
        return np.stack([log.FindLog(self.context).data().T for log in self.logs], axis=1)


def test_each_flies_as_alone_and_how_fast(save):
    field = trained("concentric-flight")[0].field
    angles = np.arange(5) * 1.1
    starts = np.column_stack([1.2 * np.cos(angles), 1.2 * np.sin(angles), np.ones(5)])
    alone = [Squad(field, 1).build().fly([start], None, SIMULATED_S)[:, 0] for start in starts]
    squads = {count: Squad(field, count).build() for count in (1, 2, 5)}
    spaced = Squad(field, 5)
    AddSpacing(spaced.builder, spaced.loops, MakeBranches(field)[0])
    squads["5, spaced"] = spaced.build()
    rows = []
    for name, squad in squads.items():
        begin = starts[: len(squad.loops)]
        states, seconds = best_of(lambda s=squad, b=begin: s.fly(b, None, SIMULATED_S), REPEATS)
        flown = states[0]
        off = [np.abs(flown[:, i] - alone[i]).max() for i in range(len(begin))]
        per_sample = 1e6 * seconds / (SIMULATED_S * 100.0 * len(begin))
        rows.append(
            {
                "vehicles": name,
                "times real time": SIMULATED_S / seconds,
                "us a sample of each": per_sample,
                "off the flight alone": max(off),
            }
        )
    save(rows, "several_vehicles")
    assert all(row["off the flight alone"] == 0.0 for row in rows[:3])


def course(name):
    """The field of a course, and its branch."""
    if name == "ring":
        field = trained("concentric-flight")[0].field
        return field, MakeBranches(field)[0]
    points = 1.5 * SHAPES["eight"].sample(600, 0.0, False, 0)
    config = sgvf.TrainingConfig(recipe="exact", seed=0)
    field = sgvf.train(PointCloud(points), config).field
    return field, MakeBranches(field)[0]


def crowd(branch, count):
    """Starts (n, 3) that are close to each other on a path; headings of a directed field."""
    first = np.round(np.arange(count) * CROWDED * len(branch.points)).astype(int)
    ahead = np.roll(branch.points, -1, axis=0)[first] - branch.points[first]
    headings = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.column_stack([branch.points[first], np.ones(count)]), headings


def settling_time(times, gaps, shares):
    """The time from which on all gaps (T, n) are as asked within `SETTLED`."""
    errors = np.abs(gaps / (shares * gaps.sum(axis=1, keepdims=True)) - 1.0).max(axis=1)
    assert errors[-1] <= SETTLED
    return times[1 + np.flatnonzero(errors > SETTLED)[-1]]


@pytest.mark.parametrize("name", COURSES)
def test_vehicles_on_one_path_are_spaced(save, out, name):
    (field, branch), (fastest, duration) = course(name), COURSES[name]
    figure, axes = plotting.new_figure(len(CASES[name]), 1, 7, 2.2 * len(CASES[name]))
    rows = []
    for axis, (case, asked) in zip(axes, CASES[name], strict=True):
        count, shares = len(asked), np.divide(asked, sum(asked))
        squad = Squad(field, count, fastest)
        spacing = AddSpacing(squad.builder, squad.loops, branch, shares)
        log = LogVectorOutput(spacing.GetOutputPort("gaps"), squad.builder, 0.1)
        states = squad.build().fly(*crowd(branch, count), duration)
        gaps, times = (
            log.FindLog(squad.context).data().T,
            log.FindLog(squad.context).sample_times(),
        )
        settled = settling_time(times, gaps, shares)
        apart = least_separation(states[:, :, :3])
        errors = field.path.project(states[500:, :, :2].reshape(-1, 2)).distance
        rows.append(
            {
                "vehicles": case,
                "length_m": spacing.length,
                "gap_at_start_m": gaps[0].min(),
                "settled_s": settled,
                "least_gap_m": gaps.min(),
                "apart_m": apart.min(),
                "apart_once_settled_m": apart[100 * int(settled) :].min(),
                "cross_track_rms_m": np.sqrt(np.mean(errors**2)),
            }
        )
        axis.plot(times, gaps, linewidth=1.0)
        axis.set(xlabel="time [s]", ylabel="gap [m]", title=f"{case} vehicles")
        axis.grid(alpha=0.3)
    figure.savefig(out / f"spacing_{name}.png")
    save(rows, f"spacing_{name}")
