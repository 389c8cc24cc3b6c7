"""What the tests of the paper's experiments share: rings, stored rows, drawn figures."""

import json

from matplotlib.backends.backend_agg import FigureCanvasAgg
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.results import plain
from sgvf_drake.fields import (
    GaussianMixture,
    GuidingField,
    PaperComposition,
    Perceptron,
    RobustComposition,
)
from sgvf_drake.paper.experiment import FOLDER

SIGMA = 0.1
HALF_EXTENT = 4.0


def linear_field(cloud, matrix, recipe="paper", gain=0.2):
    """The exact score of a cloud about the origin, and a tangent A x in units of its extent."""
    matrix = np.asarray(matrix, dtype=float) / HALF_EXTENT
    return GuidingField(
        cloud=cloud,
        sigma=SIGMA,
        score_model=GaussianMixture(cloud.normalize(cloud.points), SIGMA),
        tangent_network=Perceptron((matrix,), (np.zeros(2),), None),
        composition=(
            PaperComposition(gain) if recipe == "paper" else RobustComposition(gain, SIGMA)
        ),
        recipe=recipe,
        seed=0,
    )


def turning(angle=0.0):
    """A quarter turn, tilted outward by an angle: on x it is of the length of x."""
    return np.array([[np.sin(angle), -np.cos(angle)], [np.cos(angle), np.sin(angle)]])


def stored(rows):
    """Rows of trials after a round trip through JSON, as a reproduction stores them."""
    tables = {name: table.drop(columns=FOLDER, errors="ignore") for name, table in rows.items()}
    return {
        name: pd.DataFrame(json.loads(json.dumps(plain(table.to_dict("records")))))
        for name, table in tables.items()
    }


def ink(figure):
    """The part of a figure that is drawn upon."""
    figure.set_dpi(50)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return (np.asarray(canvas.buffer_rgba())[..., :3] < 230).any(axis=2).mean()


@pytest.fixture(scope="session")
def make_linear_field():
    """Makes fields: (cloud, matrix, recipe="paper", gain=0.2); see `linear_field`."""
    return linear_field


@pytest.fixture(scope="session")
def quarter_turn():
    """Makes matrices of fields that turn: (angle=0.0); see `turning`."""
    return turning


@pytest.fixture(scope="session")
def check_stored_rows():
    """Checks that stored rows are enough for tables and claims: (kind, rows)."""

    def check(kind, rows):
        again = stored(rows)
        assert kind.findings(again) == kind.findings(rows)
        for now, before in zip(kind.tables(again), kind.tables(rows), strict=True):
            pd.testing.assert_frame_equal(now.content, before.content, check_dtype=False)

    return check


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
