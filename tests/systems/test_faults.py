"""What a `Dropout` loses, and when."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest

from sgvf_drake.exceptions import ConfigurationError
from systems import Dropout

VALUES = np.array([1.0, -2.0, 3.0, 4.0])
INTERVALS = [(0.25, 0.5), (1.0, 1.5), (1.25, 2.0)]
ENTRIES = (0, 2)


def output(system, time, values=VALUES):
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, values)
    context.SetTime(time)
    return system.get_output_port().Eval(context)


@pytest.mark.parametrize("time", [0.0, 0.24999, 0.5, 0.75, 2.0, 100.0])
def test_values_pass_outside_the_intervals(time):
    np.testing.assert_array_equal(output(Dropout(4, INTERVALS, ENTRIES), time), VALUES)


@pytest.mark.parametrize("time", [0.25, 0.49999, 1.0, 1.3, 1.6, 1.99999])
def test_the_entries_are_lost_from_begin_until_before_the_end(time):
    lost = output(Dropout(4, INTERVALS, ENTRIES), time)
    np.testing.assert_array_equal(lost, [math.nan, -2.0, math.nan, 4.0])


@pytest.mark.parametrize(("intervals", "entries"), [([], ENTRIES), (INTERVALS, [])])
def test_nothing_is_lost_if_none_is_named(intervals, entries):
    np.testing.assert_array_equal(output(Dropout(4, intervals, entries), 0.3), VALUES)


def test_input_is_not_changed():
    system = Dropout(4, INTERVALS, ENTRIES)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, VALUES)
    context.SetTime(0.3)
    assert np.isnan(system.get_output_port().Eval(context)).any()
    np.testing.assert_array_equal(system.get_input_port().Eval(context), VALUES)


def test_output_follows_the_time_of_one_context():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(VALUES))
    system = builder.AddSystem(Dropout(4, INTERVALS, ENTRIES))
    builder.Connect(source.get_output_port(), system.get_input_port())
    log = LogVectorOutput(system.get_output_port(), builder, 0.125)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.5)
    record = log.FindLog(simulator.get_context())
    times = record.sample_times()
    lost = np.array([any(b <= t < e for b, e in INTERVALS) for t in times])
    assert lost.sum() == 2 + 8
    expected = np.tile(VALUES[:, np.newaxis], len(times))
    expected[np.ix_(ENTRIES, lost)] = math.nan
    np.testing.assert_array_equal(record.data(), expected)


@pytest.mark.parametrize("time", [0.0, 0.3])
def test_derivative_is_that_of_what_passes(time):
    converted = Dropout(4, INTERVALS, ENTRIES).ToAutoDiffXd()
    values = output(converted, time, InitializeAutoDiff(VALUES)[:, 0])
    np.testing.assert_array_equal(
        ExtractValue(values)[:, 0], output(Dropout(4, INTERVALS, ENTRIES), time)
    )
    passes = np.isfinite(ExtractValue(values)[:, 0])
    expected = np.diag(passes.astype(float))
    np.testing.assert_array_equal(ExtractGradient(values), expected)


@pytest.mark.parametrize("interval", [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.nan)])
def test_bad_interval_is_named(interval):
    with pytest.raises(ConfigurationError, match=f"from {interval[0]} to {interval[1]} s"):
        Dropout(4, [(0.0, 1.0), interval], ENTRIES)


@pytest.mark.parametrize("entry", [-1, 4])
def test_bad_entry_is_named(entry):
    with pytest.raises(ConfigurationError, match=f"no entry {entry} of 4"):
        Dropout(4, INTERVALS, [0, entry])
