"""The overview: who is looked at, when losses have come to rest, and verdicts."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.experiment import FOLDER
from sgvf_drake.paper.overview import (
    AGENTS,
    THINNING,
    Overview,
    converged,
    course,
    tangent_courses,
)

STEPS = np.arange(1_000)
FALLING = np.exp(-STEPS / 50) + 0.1
NOISE = np.random.default_rng(0).lognormal(0.0, 0.6, (10, 10))[1:]


@pytest.fixture(scope="module")
def small_run(concentric, turning_field, tmp_path_factory, run_kind):
    """A field in closed form as if it were trained, followed from 25 starts."""
    stages = (("score", "score"), ("tangent", "unit"))
    history = pd.concat(
        pd.DataFrame({"stage": stage, "iteration": STEPS, "total": FALLING, term: FALLING})
        for stage, term in stages
    )
    field = turning_field(concentric[0], recipe="robust")
    result = SimpleNamespace(guiding_field=field, history=history, restarts=0, cpu_s=1.0)
    kind = Overview(shapes=["concentric-circles"], recipes=["robust"], starts=25, seeds=[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sgvf_drake.learning.train", lambda cloud, config: result)
        return run_kind(kind, tmp_path_factory.mktemp("overview"))


def test_a_field_is_followed_and_one_agent_a_piece_comes_from_far_away(small_run):
    (row,) = small_run.rows["fields"].to_dict("records")
    assert row["reach"] == row["lap"] == 1.0
    assert row["pieces"] == row["pieces_lapped"] == 2
    assert row["all_lap"]
    assert row["rms_u"] < row["max_u"] < 0.05
    assert row["score_cosine"] == pytest.approx(1.0)
    assert list(row["losses"]) == ["total", "unit"]
    agents = np.load(row[FOLDER] / AGENTS)
    assert agents.shape[1:] == (2, 2)
    inner, outer = np.linalg.norm(agents, axis=2).T
    # The grid over +-5 has 5 x 5 starts: the middle is farthest from the inner circle of
    # those nearer to it, and a corner from the outer one.
    assert (inner[0], outer[0]) == pytest.approx((0.0, 5 * np.sqrt(2)), abs=0.01)
    steps = len(agents) - int(0.5 * 8 * np.pi / (0.05 * THINNING))
    np.testing.assert_allclose(inner[steps:], 2.0, atol=0.05)
    np.testing.assert_allclose(outer[steps:], 4.0, atol=0.05)


def test_a_run_draws_and_tells(small_run):
    assert [*small_run.figures] == ["overview_concentric-circles"]
    score, tangent, losses, plane = small_run.figures["overview_concentric-circles"].axes
    assert [line.get_label() for line in losses.lines] == ["unit"]
    # The waypoints, and a line and a dot for each agent.
    assert len(score.lines) == len(tangent.lines) == 1
    assert len(plane.lines) == 5
    assert [*small_run.tables] == ["overview_fields", "overview_losses"]
    assert set(small_run.verdicts.values()) == {Verdict.HOLDS}


@pytest.mark.parametrize(
    ("losses", "rests"),
    [
        (FALLING, True),
        (np.full(1_000, 0.3) + np.where(STEPS < 100, 0.01, 0.0), True),
        # Still falling, risen, and one that left for good halfway.
        (np.exp(-STEPS / 500), False),
        (np.exp(STEPS / 500), False),
        (FALLING + np.where(abs(STEPS - 600) < 50, 0.3, 0.0), False),
        # Noise of the batches is no change, a change of the same size without it is one:
        # ten records a tenth, as of a training of 1,000 iterations.
        (np.append(np.full(10, 50.0), NOISE), True),
        (np.append(np.full(10, 50.0), np.repeat(NOISE.mean(axis=1), 10)), False),
    ],
)
def test_when_a_loss_has_come_to_rest(losses, rests):
    found = course(pd.Series(losses))
    assert converged(found) == rests
    # Noise does not excuse everything.
    assert not converged(found | {"change": 0.3})


def test_the_course_of_a_line():
    line = course(pd.Series(1 - STEPS / 1_000))
    # Means over tenths of 0.9505, ..., 0.1505, 0.0505; two tenths of 100 even steps, each of
    # a variance of 0.1^2 / 12.
    expected = {"begin": 0.9505, "end": 0.0505, "change": -0.1 / 0.0505}
    expected |= {"error": np.sqrt(2 * 0.1**2 / 12 / 100) / 0.0505, "peak": 0.4505 / 0.0505}
    assert line == pytest.approx(expected, rel=0.01)
    for name in ("begin", "end", "change", "peak"):
        assert line[name] == pytest.approx(expected[name])


def planted(recipe="paper", seed=0, peak=1.1, change=0.01, **changes):
    total = {"begin": 1.0, "end": 0.1, "change": change, "error": 0.02, "peak": peak}
    row = {"shape": "circle", "recipe": recipe, "seed": seed, "lap": 1.0, "all_lap": True}
    row |= {"pieces": 2, "pieces_lapped": 2, "score_cosine": 0.99, "score_cosine_p5": 0.9}
    return row | {"losses": {"total": total}} | changes


GOOD, STALLS = planted(), planted(lap=0.5, all_lap=False)
HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS


@pytest.mark.parametrize(
    ("rows", "score", "losses", "tracking"),
    [
        ([GOOD, GOOD], HOLDS, HOLDS, HOLDS),
        ([GOOD, STALLS], HOLDS, HOLDS, PARTLY),
        ([STALLS, planted(pieces_lapped=1)], HOLDS, HOLDS, FAILS),
        ([planted(score_cosine=0.8), planted(score_cosine_p5=-0.1)], FAILS, HOLDS, HOLDS),
        ([GOOD, planted(change=0.3)], HOLDS, PARTLY, HOLDS),
        ([planted(peak=2.0)], HOLDS, FAILS, HOLDS),
    ],
)
def test_a_verdict_follows_from_the_fields_of_its_recipe(rows, score, losses, tracking):
    table = pd.DataFrame([*rows, planted("robust", peak=9.0, all_lap=False)])
    found = {claim.key: claim for claim in Overview().findings({"fields": table})}
    assert found["overview-score-paper"].verdict == score
    assert found["overview-losses-paper"].verdict == losses
    assert found["overview-tracking-paper"].verdict == tracking
    assert found["overview-losses-robust"].verdict == FAILS
    assert found["overview-score-paper"].of_paper
    assert not found["overview-score-robust"].of_paper


def test_tables_are_over_the_seeds(small_run):
    fields = small_run.rows["fields"]
    table = pd.concat([fields, fields.assign(all_lap=False, lap=0.5)]).assign(rms_u=[0.1, None])
    history = pd.DataFrame(
        {"stage": "tangent", "iteration": range(20), "unit": 0.25, "total": range(20, 0, -1)}
    )
    losses = [tangent_courses(history), tangent_courses(history.assign(unit=0.75))]
    tables = Overview().tables({"fields": table.assign(losses=losses)})
    found, means = (exhibit.content for exhibit in tables)
    assert found["fields followed mean"].tolist() == [0.5]
    assert found["lap mean"].tolist() == [0.75]
    assert found["RMS, U mean"].tolist() == [0.1]
    assert means["loss"].tolist() == ["unit", "total"]
    assert means["first tenth"].tolist() == [0.5, 19.5]
    assert means["last tenth"].tolist() == [0.5, 1.5]
