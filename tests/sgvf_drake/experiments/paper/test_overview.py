"""The overview: who is looked at, when losses have come to rest, and verdicts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.overview.claims import followed, overview_claims
from sgvf_drake.experiments.paper.overview.experiment import Overview, fields_table
from sgvf_drake.experiments.paper.overview.losses import (
    LossCourse,
    course,
    losses_table,
    tangent_courses,
)
from sgvf_drake.experiments.paper.overview.trials import (
    AGENTS,
    THINNING,
    OverviewTrial,
    measure_overview,
)
from sgvf_drake.experiments.workbench import Workbench

STEPS = np.arange(1_000)


@pytest.fixture(scope="module")
def measured(robust_result, tmp_path_factory):
    """One trial of the headline cloud, on the training that other tests share."""
    folder = tmp_path_factory.mktemp("overview")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sgvf_drake.learning.train", lambda cloud, config: robust_result)
        row = measure_overview(OverviewTrial("concentric-circles", "robust", 0, 25), folder)
    return row, folder


def test_the_robust_field_is_followed(measured):
    row, _ = measured
    assert row["reach"] == row["lap"] == 1.0
    assert row["pieces"] == row["pieces_lapped"] == 2
    assert followed(row)
    assert row["rms_u"] < row["max_u"] < 0.05
    assert row["score_cosine"] > 0.97
    assert 0.95 < row["speed_min"] <= row["speed_max"] < 1.05


def test_one_agent_a_piece_from_far_away(measured):
    agents = np.load(measured[1] / AGENTS)
    assert agents.shape[1:] == (2, 2)
    inner, outer = np.linalg.norm(agents, axis=2).T
    # The grid over +-5 has 5 x 5 starts: the middle is farthest from the inner circle of
    # those nearer to it, and a corner from the outer one.
    assert inner[0] == pytest.approx(0.0, abs=0.01)
    assert outer[0] == pytest.approx(5 * np.sqrt(2), abs=0.01)
    lap = 8 * np.pi
    steps = len(agents) - int(0.5 * lap / (0.05 * THINNING))
    np.testing.assert_allclose(inner[steps:], 2.0, atol=0.05)
    np.testing.assert_allclose(outer[steps:], 4.0, atol=0.05)


def test_the_kind_runs_and_draws(robust_result, tmp_path, monkeypatch):
    monkeypatch.setattr("sgvf_drake.learning.train", lambda cloud, config: robust_result)
    kind = Overview(shapes=["concentric-circles"], recipes=["robust"], starts=9, seeds=[0])
    outcome = kind.run(Workbench(tmp_path))
    assert [exhibit.name for exhibit in outcome.exhibits] == [
        "overview_concentric-circles",
        "overview_fields",
        "overview_losses",
    ]
    score, tangent, losses, plane = outcome.exhibits[0].content.axes
    labels = {line.get_label() for line in losses.lines}
    assert labels == {"unit", "orthogonality", "direction", "hint"}
    # The waypoints, and a line and a dot for each agent.
    assert len(score.lines) == len(tangent.lines) == 1
    assert len(plane.lines) == 5
    assert {claim.verdict for claim in outcome.claims} == {Verdict.HOLDS}


@pytest.mark.parametrize(
    ("losses", "converged"),
    [
        (np.exp(-STEPS / 50) + 0.1, True),
        (np.full(1_000, 0.3) + np.where(STEPS < 100, 0.01, 0.0), True),
        # Still falling, risen, and one that left for good halfway.
        (np.exp(-STEPS / 500), False),
        (np.exp(STEPS / 500), False),
        (np.exp(-STEPS / 50) + 0.1 + np.where(abs(STEPS - 600) < 50, 0.3, 0.0), False),
    ],
)
def test_when_a_loss_has_come_to_rest(losses, converged):
    assert course(pd.Series(losses)).converged == converged


def test_the_course_of_a_line():
    line = course(pd.Series(1 - STEPS / 1_000))
    # Means over tenths of 0.9505, ..., 0.1505, 0.0505.
    assert line.begin == pytest.approx(0.9505)
    assert line.end == pytest.approx(0.0505)
    assert line.change == pytest.approx(-0.1 / 0.0505)
    assert line.peak == pytest.approx(0.4505 / 0.0505)
    # Two tenths of 100 even steps, each of a variance of 0.1^2 / 12.
    assert line.error == pytest.approx(np.sqrt(2 * 0.1**2 / 12 / 100) / 0.0505, rel=0.01)


def test_noise_of_the_batches_is_no_change():
    # Ten records a tenth, as of a training of 1,000 iterations.
    noise = np.random.default_rng(0).lognormal(0.0, 0.6, 100)
    noisy = course(pd.Series(np.where(np.arange(100) < 10, 50.0, noise)))
    assert 0.1 < abs(noisy.change) < 0.2
    assert noisy.converged
    # Noise does not excuse everything.
    assert not replace(noisy, change=0.3).converged
    # A change of the same size without the noise is one.
    means = np.repeat(noise.reshape(10, 10).mean(axis=1), 10)
    steps = course(pd.Series(np.where(np.arange(100) < 10, 50.0, means)))
    assert steps.change == pytest.approx(noisy.change)
    assert not steps.converged


def test_only_the_losses_of_the_tangent_are_told():
    history = pd.DataFrame(
        {
            "stage": ["score"] * 20 + ["tangent"] * 20,
            "iteration": [*range(20), *range(20)],
            "score": [1.0] * 20 + [np.nan] * 20,
            "unit": [np.nan] * 20 + [0.25] * 20,
            "total": [1.0] * 20 + [0.25] * 20,
        }
    )
    assert list(tangent_courses(history)) == ["unit", "total"]
    table = losses_table({("circle", "paper"): [history, history.assign(unit=0.75)]})
    assert table["loss"].tolist() == ["unit", "total"]
    assert table["last tenth"].tolist() == [0.5, 0.25]


def planted(**changes):
    row = {"lap": 1.0, "all_lap": True, "pieces": 2, "pieces_lapped": 2}
    return row | {"score_cosine": 0.99, "score_cosine_p5": 0.9} | changes


REST = LossCourse(1.0, 0.1, 0.01, 0.02, 1.1)
GOOD, STALLS = planted(), planted(lap=0.5, all_lap=False)
ONE_PIECE = planted(pieces_lapped=1)


@pytest.mark.parametrize(
    ("rows", "totals", "expected"),
    [
        ([GOOD, GOOD], [REST, REST], ["holds", "holds", "holds"]),
        ([GOOD, STALLS], [REST, REST], ["holds", "holds", "holds in part"]),
        ([STALLS, ONE_PIECE], [REST, REST], ["holds", "holds", "does not hold"]),
        (
            [planted(score_cosine=0.8), planted(score_cosine_p5=-0.1)],
            [REST, LossCourse(1.0, 0.1, 0.3, 0.02, 1.1)],
            ["does not hold", "holds in part", "holds"],
        ),
        (
            [GOOD],
            [LossCourse(1.0, 0.1, 0.01, 0.02, 2.0)],
            ["holds", "does not hold", "holds"],
        ),
    ],
)
def test_a_verdict_follows_from_its_figures(rows, totals, expected):
    claims = overview_claims({"paper": rows}, {"paper": totals})
    keys = ["overview-score-paper", "overview-losses-paper", "overview-tracking-paper"]
    assert [claim.key for claim in claims] == keys
    assert [claim.verdict for claim in claims] == expected


def test_the_table_counts_fields(measured):
    row, _ = measured
    rows = [row, row | {"all_lap": False, "lap": 0.5, "rms_u": None}]
    table = fields_table({("concentric-circles", "robust"): rows})
    (found,) = table.to_dict("records")
    assert found["fields followed mean"] == 0.5
    assert found["lap mean"] == 0.75
    assert found["RMS, U mean"] == row["rms_u"]
