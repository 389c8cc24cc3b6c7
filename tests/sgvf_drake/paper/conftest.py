"""What the tests of the paper's experiments share: rings, stored rows, drawn figures."""

from types import SimpleNamespace

from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.paper.experiment import load_rows, save_rows
from tests.fields import exact_field

HALF_EXTENT = 4.0


@pytest.fixture(scope="session")
def turning_field():
    """Makes fields: the exact score of a cloud about the origin, and v a quarter turn of x.

    (cloud, angle=0.0, size=1.0, recipe="paper", gain=0.2): the turn is tilted outward by the
    angle, and v is of the given size where x is at the extent of the cloud.
    """

    def make(cloud, angle=0.0, size=1.0, recipe="paper", gain=0.2):
        turn = np.array([[np.sin(angle), -np.cos(angle)], [np.cos(angle), np.sin(angle)]])
        return exact_field(cloud, size * turn / HALF_EXTENT, gain=gain, composition=recipe)

    return make


def ink(figure):
    """The part of a figure that is drawn upon."""
    figure.set_dpi(50)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return (np.asarray(canvas.buffer_rgba())[..., :3] < 230).any(axis=2).mean()


@pytest.fixture(scope="session")
def run_kind():
    """Runs an experiment, and checks what it left: pictures, and the same from stored rows."""

    def run(kind, folder):
        rows = kind.measure(Workbench(folder))
        found = SimpleNamespace(
            rows=rows,
            figures={one.name: one.content for one in kind.figures(rows)},
            tables={one.name: one.content for one in kind.tables(rows)},
            logs=kind.logs(rows),
            verdicts={one.key: one.verdict for one in kind.findings(rows)},
        )
        for name, figure in found.figures.items():
            assert 0.02 < ink(figure) < 0.9, name
        save_rows(rows, folder / "rows.json")
        again = load_rows(folder / "rows.json")
        assert kind.findings(again) == kind.findings(rows)
        for table in kind.tables(again):
            pd.testing.assert_frame_equal(table.content, found.tables[table.name])
        for name, log in kind.logs(again).items():
            pd.testing.assert_frame_equal(log, found.logs[name])
        return found

    return run
