"""What the tests of the paper's experiments share: rings, stored rows, drawn figures."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.paper.experiment import FOLDER, load_rows, save_rows
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


@pytest.fixture
def check_stored_rows(tmp_path):
    """Checks that rows are enough for tables and claims after they were stored."""

    def check(kind, rows):
        tables = {name: table.drop(columns=FOLDER) for name, table in rows.items()}
        save_rows(tables, tmp_path / "rows.json")
        again = load_rows(tmp_path / "rows.json")
        assert kind.findings(again) == kind.findings(rows)
        for now, before in zip(kind.tables(again), kind.tables(rows), strict=True):
            pd.testing.assert_frame_equal(now.content, before.content, check_dtype=False)

    return check


@pytest.fixture
def check_outcome(tmp_path):
    """Checks what a run of an experiment left: pictures, and the same from stored rows."""

    def check(experiment, outcome):
        save_rows(outcome.rows, tmp_path / "outcome.json")
        rows = load_rows(tmp_path / "outcome.json")
        figures = [e for e in outcome.exhibits if not isinstance(e.content, pd.DataFrame)]
        for figure in figures:
            assert 0.02 < ink(figure.content) < 0.9, figure.name
        tables = experiment.tables(rows)
        for before, after in zip(outcome.exhibits[len(figures) :], tables, strict=True):
            pd.testing.assert_frame_equal(before.content, after.content)
        assert experiment.findings(rows) == outcome.claims
        for name, log in experiment.logs(rows).items():
            pd.testing.assert_frame_equal(outcome.logs[name], log)

    return check
