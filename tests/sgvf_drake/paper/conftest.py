"""What the tests of several experiments share."""

import json

from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.results import plain


def stored(rows):
    """The rows of trials as they are read from a store: JSON values, and no folders."""
    return {
        name: pd.DataFrame(json.loads(json.dumps(plain(table.to_dict("records")))))
        for name, table in rows.items()
    }


def ink(figure):
    """The part of a figure that is drawn upon."""
    figure.set_dpi(50)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return (np.asarray(canvas.buffer_rgba())[..., :3] < 230).any(axis=2).mean()


@pytest.fixture
def check_outcome():
    """Checks what a run of an experiment left: pictures, and the same from stored rows."""

    def check(experiment, outcome):
        rows = stored(outcome.rows)
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
