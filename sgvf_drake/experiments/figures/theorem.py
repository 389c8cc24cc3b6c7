"""The figure of Theorem 1 along trajectories."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import IntArray
from sgvf_drake.experiments.theorem import DecreaseCheck, LevelSetCheck, ModeCheck

# Trajectories of V that are drawn: an even selection of many.
MAX_LINES = 150
# The way in is drawn up to this many times the last entry.
SHOWN_ENTRIES = 2.5
# V goes through zero on the modes; it is drawn down to this part of the band's lower end.
SHOWN_BELOW = 0.02
LEVEL_COLORS = (plotting.BLUE, plotting.ORANGE, plotting.GREEN, plotting.RED)


def theorem_figure(
    decrease: DecreaseCheck, level_sets: LevelSetCheck, modes: ModeCheck
) -> Figure:
    """Returns one panel for each part of Theorem 1.

    They show V along x_dot = m, with the band through which it should fall; V along
    x_dot = v alone, with the levels that it should keep; and |m| on the modes.
    """
    figure, axes = plotting.new_figure(1, 3, 15, 4.8)
    _draw_decrease(axes[0], decrease)
    _draw_level_sets(axes[1], level_sets)
    _draw_modes(axes[2], modes)
    return figure


def _draw_decrease(axes: Axes, check: DecreaseCheck) -> None:
    run, (c_in, c_out) = check.run, check.band
    entered = np.isfinite(check.entry_times)
    axes.axhspan(
        c_in, c_out, color=plotting.ORANGE, alpha=0.2, label=f"band, {c_in:.3g} to {c_out:.3g}"
    )
    for agents, color, label in (
        (entered, plotting.BLUE, "agent"),
        (~entered, plotting.RED, "did not get below it"),
    ):
        shown = _selection(np.flatnonzero(agents))
        lines = axes.plot(run.times, run.V[:, shown], color=color, linewidth=0.6, alpha=0.5)
        for line in lines[:1]:
            line.set_label(label)
    if run.exit is not None:
        (marker,) = axes.plot(run.exit.time, run.exit.V, "X", color=plotting.RED, clip_on=False)
        marker.set(markersize=9, label="left it, which ends the run")
    end = run.times[-1]
    if entered.all():
        end = min(end, SHOWN_ENTRIES * max(check.entry_times.max(), run.times[1]))
    axes.set(
        xlabel="time at unit speed",
        ylabel="V",
        yscale="log",
        xlim=(0, end),
        ylim=(SHOWN_BELOW * c_in, 2 * c_out),
        title=f"(i) along m: {entered.sum()} of {len(entered)} fall through the band",
    )
    axes.legend(loc="upper right")
    axes.grid(alpha=0.3)


def _draw_level_sets(axes: Axes, check: LevelSetCheck) -> None:
    drift = check.drift.max(axis=1) / check.levels
    for number, (level, run) in enumerate(zip(check.levels, check.runs, strict=True)):
        color = LEVEL_COLORS[number % len(LEVEL_COLORS)]
        axes.axhline(level, color=color, linestyle="--", linewidth=1.2)
        axes.plot(run.times, run.V, color=color, linewidth=0.6, alpha=0.6)
        axes.annotate(
            f"{drift[number]:.0%}" if drift[number] < 10 else f"{drift[number]:.0f}-fold",
            (1.01, level),
            xycoords=("axes fraction", "data"),
            color=color,
        )
    axes.set(
        xlabel="time",
        ylabel="V",
        yscale="log",
        xlim=(0, check.runs[0].times[-1]),
        title="(ii) along v alone: levels to keep, and largest drift",
    )
    axes.grid(alpha=0.3)


def _draw_modes(axes: Axes, check: ModeCheck) -> None:
    order = np.argsort(check.speeds)
    share = 100 * (np.arange(len(order)) + 0.5) / len(order)
    highest = int(np.flatnonzero(order == check.V.argmin())[0])
    axes.axhline(1.0, color=plotting.GREY, linestyle="--", label="unit length")
    axes.plot(share, check.speeds[order], ".", color=plotting.BLUE, label="mode")
    axes.plot(
        share[highest],
        check.speeds[order[highest]],
        "*",
        color=plotting.RED,
        markersize=12,
        label="global mode",
    )
    axes.set(
        xlabel="share of the modes [%]",
        ylabel="|m|",
        ylim=(0, 1.1 * max(1.0, check.speeds.max())),
        title=f"(iii) speed on the {len(order)} modes",
    )
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)


def _selection(agents: IntArray) -> IntArray:
    if len(agents) <= MAX_LINES:
        return agents
    return agents[np.linspace(0, len(agents) - 1, MAX_LINES).astype(int)]
