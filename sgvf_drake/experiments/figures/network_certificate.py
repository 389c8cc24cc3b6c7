"""The figure of a network's certificate: tubes over its edges, and what is not proved."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.network import NetworkCertificate, Stretch
from sgvf_drake.certificate.tube import corners
from sgvf_drake.experiments.figures.network import draw_network
from sgvf_drake.experiments.figures.verification import TUBE
from sgvf_drake.fields import DirectedField

TURN = plotting.ORANGE
# Entries of the legend below each view, so that they fit.
LEGEND_COLUMNS = 4


def network_certificate_figure(field: DirectedField, found: NetworkCertificate) -> Figure:
    """Draws the borders of all tubes, in the plane, or in space from above and from the side.

    A cross stands where a robot ended that does not follow, or where it would have begun.

    Args:
        field: In the unit of its waypoints.
        found: What is proved of it.
    """
    views = [(0, 1)] if field.dim == 2 else [(0, 1), (0, 2)]
    figure, axes = plotting.new_figure(1, len(views), 7 * len(views), 6.4)
    kinds = (
        (found.sections, TUBE, "sections"),
        (found.turns, TURN, "turns"),
        (found.ends, plotting.BLUE, "ways to rest"),
    )
    for view, plane in zip(views, axes, strict=True):
        draw_network(plane, field.cloud.points, field.network, view)
        for stretches, color, label in kinds:
            _draw_tubes(plane, field, stretches, view, color, label)
        places = [own.where for own in found.stretches if own.where]
        if places:
            x, y = np.array(places)[:, view].T
            plane.plot(x, y, "x", color=plotting.RED, ls="", label="not proved", zorder=4)
        plane.set(xlabel="xyz"[view[0]], ylabel="xyz"[view[1]], aspect="equal")
    verdict = "certified" if found.certified else "NOT certified"
    figure.suptitle(f"{verdict}: {found.reason}", wrap=True)
    handles, labels = axes[0].get_legend_handles_labels()
    plotting.legend_below(figure, handles, labels, LEGEND_COLUMNS * len(views))
    return figure


def _draw_tubes(
    axes: Axes,
    field: DirectedField,
    stretches: list[Stretch],
    view: tuple[int, int],
    color: str,
    label: str,
) -> None:
    lines: list[FloatArray] = []
    for leg in (leg for stretch in stretches for leg in stretch.legs):
        for line in np.moveaxis(corners(leg.tube.rows), 1, 0):
            # Between lines that are not joined.
            lines += [field.cloud.denormalize(line), np.full((1, field.dim), np.nan)]
    if lines:
        x = np.concatenate(lines)[:, view]
        axes.plot(*x.T, color=color, linewidth=0.8, label=label, zorder=3)
