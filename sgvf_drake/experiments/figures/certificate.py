"""The figure of a certificate: the set, the tube in it, and what the levels tolerate."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.certificate import Certificate
from sgvf_drake.experiments.figures.verification import BELOW, FALLS, LEVELS, TUBE
from sgvf_drake.fields import GaussianMixture, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# Pixels along each side of the map, and level sets of V in the band.
PIXELS, NUM_LEVELS = 401, 7


def certificate_figure(field: GuidingField, found: Certificate) -> Figure:
    """Returns a map of the certified set with the field, and e* over the levels."""
    figure, axes = plotting.new_figure(1, 2, 12.5, 6.4)
    plotting.plot_field(axes[0], field, field.cloud.box)
    if found.sigma is not None:
        _plot_sets(axes[0], field, found)
    plotting.plot_waypoints(axes[0], field.cloud.points)
    if found.counterexample is not None:
        axes[0].plot(*found.counterexample, "X", color=plotting.RED, markersize=9)
    title = "certified" if found.certified else "NOT certified"
    plotting.plane_axes(axes[0], "unit of the waypoints", title)
    _plot_margin(axes[1], found)
    return figure


def _plot_sets(axes: Axes, field: GuidingField, found: Certificate) -> None:
    assert found.conditions is not None
    assert found.sigma is not None
    c_in, c_out = found.conditions.c_in, found.conditions.c_out
    function = LyapunovFunction(GaussianMixture(field.mixture.points, found.sigma))
    lower, upper = field.cloud.box
    x, y = (np.linspace(lower[k], upper[k], PIXELS) for k in range(2))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    V = function(points).reshape(PIXELS, PIXELS)
    axes.contourf(x, y, V, [c_in, c_out], colors=[FALLS], alpha=0.7)
    axes.contourf(x, y, V, [-1, c_in], colors=[TUBE])
    levels = np.geomspace(c_in, c_out, NUM_LEVELS)
    axes.contour(x, y, V, levels, colors=[LEVELS], linewidths=0.6)
    handles = [
        Patch(color=FALLS, label="every robot from here enters the tube"),
        Patch(color=TUBE, label="the tube, with a closed orbit around each hole"),
    ]
    axes.legend(handles=handles, **BELOW)


def _plot_margin(axes: Axes, found: Certificate) -> None:
    axes.set(xlabel="level of V", ylabel="disturbance, part of the speed")
    axes.set_title("disturbance that a level set tolerates, at least")
    axes.grid(alpha=0.3)
    if not found.e_star:
        axes.text(0.5, 0.5, "nothing is proved", ha="center", transform=axes.transAxes)
        return
    axes.stairs(found.e_star, found.levels, color=plotting.BLUE, linewidth=1.5)
    axes.set(xscale="log", ylim=(0, None))
