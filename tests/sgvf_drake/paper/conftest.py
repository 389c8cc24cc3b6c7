"""Fields in closed form that follow rings, and a check of rows as they are stored."""

import json

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

SIGMA, HALF_EXTENT = 0.1, 4.0


@pytest.fixture(scope="session")
def turning_field():
    """Makes fields: the exact score of a cloud about the origin, and v a quarter turn of x.

    (cloud, angle=0.0, size=1.0, recipe="paper", gain=0.2): the turn is tilted outward by the
    angle, and v is of the given size where x is at the extent of the cloud.
    """

    def make(cloud, angle=0.0, size=1.0, recipe="paper", gain=0.2):
        turn = np.array([[np.sin(angle), -np.cos(angle)], [np.cos(angle), np.sin(angle)]])
        robust = RobustComposition(gain, SIGMA)
        return GuidingField(
            cloud=cloud,
            sigma=SIGMA,
            score_model=GaussianMixture(cloud.normalize(cloud.points), SIGMA),
            tangent_network=Perceptron((size * turn / HALF_EXTENT,), (np.zeros(2),), None),
            composition=PaperComposition(gain) if recipe == "paper" else robust,
            recipe=recipe,
            seed=0,
        )

    return make


@pytest.fixture(scope="session")
def check_stored_rows():
    """Checks that rows are enough for tables and claims after a round trip through JSON."""

    def check(kind, rows):
        again = {}
        for name, table in rows.items():
            records = table.drop(columns=FOLDER).to_dict("records")
            again[name] = pd.DataFrame(json.loads(json.dumps(plain(records))))
        assert kind.findings(again) == kind.findings(rows)
        for now, before in zip(kind.tables(again), kind.tables(rows), strict=True):
            pd.testing.assert_frame_equal(now.content, before.content, check_dtype=False)

    return check
