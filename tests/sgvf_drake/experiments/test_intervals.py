"""Intervals over seeds: how often they hold the truth, and what they do with little."""

import math

import numpy as np
import pytest
from scipy import stats

from sgvf_drake.experiments.intervals import (
    CONFIDENCE,
    SHARE,
    fraction_columns,
    fraction_interval,
    interval,
    interval_columns,
)


def test_the_interval_is_that_of_an_independent_implementation():
    values = np.random.default_rng(3).normal(1.0, 2.0, 7)
    found = stats.ttest_1samp(values, 0.0).confidence_interval(CONFIDENCE)
    assert interval(values) == pytest.approx((values.mean(), found.low, found.high))


def test_intervals_that_are_compared_hold_their_means_together():
    repeats, comparisons = 200, 14
    values = np.random.default_rng(5).normal(2.0, 3.0, (repeats, comparisons, 5))
    ends = np.array([[interval(v, comparisons=comparisons)[1:] for v in row] for row in values])
    together = ((ends[..., 0] <= 2.0) & (ends[..., 1] >= 2.0)).all(axis=1).mean()
    # Independent ones hold together a little more often than Bonferroni's bound says.
    expected = (1 - (1 - CONFIDENCE) / comparisons) ** comparisons
    assert together == pytest.approx(expected, abs=3 * math.sqrt(0.05 * 0.95 / repeats))


def test_the_interval_of_a_share_is_cut_to_what_a_share_can_be():
    values = [0.7, 1.0, 1.0]
    mean, low, high = interval(values, SHARE)
    assert interval(values)[2] > 1.0
    assert (mean, low, high) == (interval(values)[0], interval(values)[1], 1.0)


def test_what_is_missing_is_left_out_and_a_single_value_says_nothing_of_the_spread():
    nan = math.nan
    for values, expected in (
        ([1.0, nan, 2.0, 4.0, nan], interval([1.0, 2.0, 4.0])),
        ([nan, 0.25], (0.25, nan, nan)),
        ([], (nan, nan, nan)),
        ([nan, nan], (nan, nan, nan)),
        ([0.5] * 5, (0.5, 0.5, 0.5)),
    ):
        np.testing.assert_array_equal(interval(values), expected)


def wilson(successes, trials):
    """Wilson's interval as it is printed in textbooks."""
    z, p = stats.norm.ppf((1 + CONFIDENCE) / 2), successes / trials
    middle = p + z**2 / (2 * trials)
    half = z * math.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2))
    return p, (middle - half) / (1 + z**2 / trials), (middle + half) / (1 + z**2 / trials)


@pytest.mark.parametrize(
    ("successes", "trials"), [(0, 1), (1, 1), (0, 5), (3, 5), (5, 5), (17, 400)]
)
def test_fractions_have_wilsons_interval(successes, trials):
    found = fraction_interval(successes, trials)
    assert found == pytest.approx(wilson(successes, trials), abs=1e-12)
    assert 0.0 <= found[1] < found[2] <= 1.0


def test_columns_of_a_table_have_the_names_that_the_report_looks_for():
    values = [1.0, 2.0, 4.0]
    columns = interval_columns("RMS, U", values)
    assert list(columns) == ["RMS, U mean", "RMS, U low", "RMS, U high"]
    # A length: the interval of these three would begin below zero.
    assert tuple(columns.values()) == interval(values, (0.0, math.inf))
    assert columns["RMS, U low"] == 0.0
    anywhere = interval_columns("z", values, (-math.inf, math.inf))
    assert tuple(anywhere.values()) == interval(values)
    columns = fraction_columns("laps", [True, False, True])
    assert columns == dict(
        zip(("laps mean", "laps low", "laps high"), fraction_interval(2, 3), strict=True)
    )
