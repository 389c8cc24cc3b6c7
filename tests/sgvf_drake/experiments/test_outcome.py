"""Verdicts of several outcomes."""

import pytest

from sgvf_drake.experiments.outcome import Verdict


@pytest.mark.parametrize(
    ("outcomes", "verdict"),
    [
        ([True], Verdict.HOLDS),
        ([True, True], Verdict.HOLDS),
        ([True, False], Verdict.PARTLY),
        ([False], Verdict.FAILS),
        ([], Verdict.FAILS),
    ],
)
def test_a_claim_holds_where_all_outcomes_are_good(outcomes, verdict):
    assert Verdict.of(outcomes) is verdict
    assert Verdict.of(iter(outcomes)) is verdict
