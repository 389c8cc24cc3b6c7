"""The motion capture with noise and delay: what arrives when, and how noisy it is."""

from dataclasses import replace
import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.common import RandomGenerator
from pydrake.polynomial import Polynomial
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
import pytest
from scipy.signal import lfilter

from sgvf_drake.exceptions import ConfigurationError
from systems import Dropout, IdealMotionCapture, MotionCapture, SensorParameters
from systems.quadrotor import ATTITUDE, POSITION, RATES, VELOCITY
from systems.sensing import DrawNoise

NOISELESS = SensorParameters(position_noise=0.0, attitude_noise=0.0, rate_noise=0.0)
PERIOD, ONBOARD_PERIOD = NOISELESS.sample_period, NOISELESS.onboard_period
DELAYS = [0.0, 0.01, 0.03]
STATE = np.concatenate(([1.3, -0.4, 1.1], np.random.default_rng(3).uniform(-1.0, 1.0, 9)))
NOISY_ENTRIES = [*range(6), 9, 10, 11]


def smooth_motion(duration=2.0):
    """A motion of the whole state (12) that starts with the position at rest."""
    rng = np.random.default_rng(5)
    times = np.linspace(0.0, duration, 9)
    ends = np.zeros((12, 1))
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        times, rng.uniform(-1.0, 1.0, (12, len(times))), ends, ends
    )


def polynomial_motion(*coefficients):
    """A motion of the position with these coefficients (3,) of 1, t, t^2..; zeros elsewhere."""
    rows = np.zeros((12, len(coefficients)))
    rows[POSITION] = np.column_stack(coefficients)
    return PiecewisePolynomial([np.array([[Polynomial(row)] for row in rows])], [0.0, 3.0])


class Setup:
    """A motion capture that sees the output of a source, with logs of what it tells."""

    def __init__(self, parameters, source, acceleration=None, dropout=None):
        builder = DiagramBuilder()
        seen = builder.AddSystem(source).get_output_port()
        if dropout is not None:
            lost = builder.AddSystem(dropout)
            builder.Connect(seen, lost.get_input_port())
            seen = lost.get_output_port()
        self.capture = builder.AddNamedSystem("motion_capture", MotionCapture(parameters))
        builder.Connect(seen, self.capture.GetInputPort("state"))
        if acceleration is not None:
            builder.Connect(
                builder.AddSystem(ConstantVectorSource(acceleration)).get_output_port(),
                self.capture.GetInputPort("acceleration"),
            )
        # It sees what holds until its sample.
        self.log = LogVectorOutput(
            self.capture.GetOutputPort("state"), builder, parameters.onboard_period
        )
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.own = self.capture.GetMyMutableContextFromRoot(self.context)

    def output(self, name):
        return self.capture.GetOutputPort(name).Eval(self.own)

    def after_sample(self, k):
        """Goes to half a period of the faster sensor after the k-th sample of the slower."""
        period = self.capture.parameters.sample_period
        self.simulator.AdvanceTo(k * period + 0.5 * self.capture.parameters.onboard_period)
        return self.output("state")

    def noise(self, seed=None, duration=0.4):
        """The log of a new simulation, without what holds at the start."""
        if seed is not None:
            DrawNoise(self.capture, self.own, RandomGenerator(seed))
        self.simulator.AdvanceTo(duration)
        return self.log.FindLog(self.context).data().T[1:]


def noisy_setup(parameters, seed=None, duration=0.4):
    setup = Setup(parameters, ConstantVectorSource(STATE))
    setup.capture.SetVectorState(setup.own, STATE)
    return setup.noise(seed, duration)


@pytest.mark.parametrize("delay", DELAYS)
def test_delay_of_the_chain_is_that_of_the_parameters(delay):
    """The estimate is what SciPy's filter makes of the true positions of `delay` ago."""
    motion, parameters = smooth_motion(), replace(NOISELESS, delay=delay)
    setup = Setup(parameters, TrajectorySource(motion))
    start = motion.value(0.0)[:, 0]
    start[VELOCITY] = 0.0
    setup.capture.SetVectorState(setup.own, start)
    count = 80
    then = np.maximum(PERIOD * np.arange(count) - delay, 0.0)
    seen = np.array([motion.value(t)[POSITION, 0] for t in then]) - start[POSITION]
    pole = math.exp(-parameters.bandwidth * PERIOD)
    alpha, beta = 1.0 - pole**2, (1.0 - pole) ** 2
    denominator = [1.0, alpha + beta - 2.0, 1.0 - alpha]
    velocity = lfilter([beta / PERIOD, -beta / PERIOD], denominator, seen, axis=0)
    position = lfilter([alpha, beta - alpha], denominator, seen, axis=0) + delay * velocity
    estimates = np.array([setup.after_sample(k) for k in range(count)])
    np.testing.assert_allclose(
        estimates[:, POSITION] - start[POSITION], position, rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(estimates[:, VELOCITY], velocity, rtol=0, atol=1e-10)
    assert np.abs(velocity).max() > 1.0


def test_attitude_and_rates_are_sampled_at_the_onboard_rate():
    motion = smooth_motion()
    setup = Setup(NOISELESS, TrajectorySource(motion))
    for step in range(1, 40):
        setup.simulator.AdvanceTo((step + 0.5) * ONBOARD_PERIOD)
        state, true = setup.output("state"), motion.value(ONBOARD_PERIOD * step)[:, 0]
        for part in (ATTITUDE, RATES):
            np.testing.assert_allclose(state[part], true[part], atol=1e-12)
        for name, part in (("position", POSITION), ("velocity", VELOCITY)):
            np.testing.assert_array_equal(state[part], setup.output(name))


# 7 PERIOD / PERIOD is a little more than 7.
@pytest.mark.parametrize("moment", [0.0, 7.0, 7.2, 7.7])
@pytest.mark.parametrize("delay", DELAYS)
def test_state_that_is_set_is_the_estimate_and_makes_no_transient(delay, moment):
    motion = polynomial_motion(STATE[POSITION], STATE[VELOCITY])
    setup = Setup(replace(NOISELESS, delay=delay), TrajectorySource(motion))
    time = moment * PERIOD
    if moment:
        setup.simulator.AdvanceTo(time)
    state = STATE.copy()
    state[POSITION] = motion.value(time)[POSITION, 0]
    setup.capture.SetVectorState(setup.own, state)
    np.testing.assert_allclose(setup.output("state"), state, atol=1e-15)
    assert setup.output("measurement_age") == [delay]
    for k in range(math.ceil(moment), math.ceil(moment) + 12):
        estimate = setup.after_sample(k)
        np.testing.assert_allclose(
            estimate[POSITION], motion.value(k * PERIOD)[POSITION, 0], atol=1e-12
        )
        np.testing.assert_allclose(estimate[VELOCITY], STATE[VELOCITY], atol=1e-11)


@pytest.mark.parametrize("delay", DELAYS)
def test_constant_acceleration_is_followed_without_error(delay):
    acceleration = np.array([0.5, -1.0, 0.3])
    motion = polynomial_motion(STATE[POSITION], STATE[VELOCITY], 0.5 * acceleration)
    setup = Setup(replace(NOISELESS, delay=delay), TrajectorySource(motion), acceleration)
    estimate, t = setup.after_sample(120), 120 * PERIOD
    rate = motion.EvalDerivative(t)[POSITION, 0]
    np.testing.assert_allclose(estimate[POSITION], motion.value(t)[POSITION, 0], atol=1e-9)
    np.testing.assert_allclose(estimate[VELOCITY], rate, atol=1e-9)


@pytest.mark.parametrize("start", [0, 500])
@pytest.mark.parametrize("delay", DELAYS)
def test_start_that_was_not_set_is_the_first_measurement(delay, start):
    setup = Setup(replace(NOISELESS, delay=delay), ConstantVectorSource(STATE))
    setup.context.SetTime(start * PERIOD)
    first = start + round(delay / PERIOD)
    for k in range(start, first + 5):
        estimate = setup.after_sample(k)
        np.testing.assert_array_equal(
            estimate[POSITION], STATE[POSITION] if k >= first else np.zeros(3)
        )
        np.testing.assert_array_equal(estimate[VELOCITY], 0.0)


def test_lost_position_is_bridged_and_ages():
    delay = 0.01
    setup = Setup(
        replace(NOISELESS, delay=delay),
        ConstantVectorSource(STATE),
        dropout=Dropout(12, [(0.195, 0.295)], [1]),
    )
    setup.capture.SetVectorState(setup.own, [*STATE[:6], 0.0, 0.0, 0.0, *STATE[9:]])
    for k in range(40):
        estimate = setup.after_sample(k)
        np.testing.assert_allclose(estimate[POSITION], STATE[POSITION], atol=1e-14)
        # Lost are the samples of 0.2 to 0.29 s, which arrive one period later.
        lost = k - 20 if 20 < k <= 30 else 0
        assert setup.output("measurement_age")[0] == pytest.approx(delay + lost * PERIOD)


def test_noise_has_the_deviations_of_the_parameters_and_is_independent():
    # So fast an estimator, and no delay: the estimate is what was measured.
    parameters = SensorParameters(
        delay=0.0, position_noise=2e-3, attitude_noise=3e-3, rate_noise=0.02, bandwidth=1e5
    )
    noise = (noisy_setup(parameters, 0, 20.0) - STATE)[:, NOISY_ENTRIES]
    noise /= np.repeat([2e-3, 3e-3, 0.02], 3)
    # A position holds for so many samples of the attitude.
    held = round(PERIOD / ONBOARD_PERIOD)
    slow = noise[::held]
    for values in (slow[:, :3], noise[:, 3:]):
        count = len(values)
        assert np.all(np.abs(values.mean(axis=0)) < 4.0 / math.sqrt(count))
        assert np.all(np.abs(values.var(axis=0) - 1.0) < 4.0 * math.sqrt(2.0 / count))
        # A sample is not like the one before it.
        across = values[1:].T @ values[:-1] / (count - 1)
        assert np.abs(across).max() < 5.0 / math.sqrt(count)
    # What has a noise of its own shares nothing with the others.
    other = np.corrcoef(slow.T) - np.eye(slow.shape[1])
    assert np.abs(other).max() < 5.0 / math.sqrt(len(slow))


def test_seed_repeats_exactly_whatever_was_before_and_another_does_not():
    fresh, other = noisy_setup(SensorParameters(), 1), noisy_setup(SensorParameters(), 2)
    setup = Setup(SensorParameters(), ConstantVectorSource(STATE))
    setup.noise(7)
    setup.context.SetTimeStateAndParametersFrom(
        setup.simulator.get_system().CreateDefaultContext()
    )
    setup.capture.SetVectorState(setup.own, STATE)
    setup.log.FindMutableLog(setup.context).Clear()
    setup.simulator.Initialize()
    np.testing.assert_array_equal(fresh, setup.noise(1))
    # No value is by chance what it was, once the first sample has arrived.
    assert np.all(fresh[20:] != other[20:])
    # A generator draws anew each time, and the same as another of its seed.
    found, generator = [], RandomGenerator(3)
    for source in (generator, generator, RandomGenerator(3)):
        setup = Setup(SensorParameters(), ConstantVectorSource(STATE))
        setup.simulator.get_system().SetRandomContext(setup.context, source)
        setup.capture.SetVectorState(setup.own, STATE)
        found.append(setup.noise())
    assert np.all(found[0][20:] != found[1][20:])
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize("parameters", [SensorParameters(), replace(NOISELESS, delay=0.0)])
def test_motion_capture_converts_with_its_state_and_feeds_nothing_through(parameters):
    capture = MotionCapture(parameters)
    assert not capture.HasAnyDirectFeedthrough()
    context = capture.CreateDefaultContext()
    capture.SetVectorState(context, STATE)
    converted = capture.ToAutoDiffXd()
    converted_context = converted.CreateDefaultContext()
    converted_context.SetTimeStateAndParametersFrom(context)
    values = converted.GetOutputPort("state").Eval(converted_context)
    np.testing.assert_allclose([v.value() for v in values], STATE, atol=1e-15)


MUST_BE_POSITIVE = ("sample_period", "onboard_period", "bandwidth")


@pytest.mark.parametrize("name", SensorParameters.__dataclass_fields__)
def test_value_that_cannot_be_is_named(name):
    bad = [-0.01, math.nan, math.inf, *([0.0] if name in MUST_BE_POSITIVE else [])]
    if name == "delay":
        bad += [0.005, 0.015, 0.0101]  # No multiples of the period.
    for value in bad:
        with pytest.raises(ConfigurationError, match=rf"^{name} .*{value}"):
            SensorParameters(**{name: value})


@pytest.mark.parametrize("period", [0.02, 0.0])
def test_ideal_motion_capture_samples_or_passes(period):
    motion = smooth_motion()
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(motion))
    capture = builder.AddSystem(IdealMotionCapture(period))
    builder.Connect(source.get_output_port(), capture.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.05)
    own = capture.GetMyContextFromRoot(simulator.get_context())
    true = motion.value(0.04 if period else 0.05)[:, 0]
    for name, part in (
        ("state", slice(12)),
        ("position", POSITION),
        ("velocity", VELOCITY),
    ):
        found = capture.GetOutputPort(name).Eval(own)
        np.testing.assert_allclose(found, true[part], atol=1e-14)


# What can be lost.

VALUES = np.array([1.0, -2.0, 3.0, 4.0])
INTERVALS = [(0.25, 0.5), (1.0, 1.5), (1.25, 2.0)]
ENTRIES = (0, 2)


@pytest.mark.parametrize(
    ("intervals", "entries"), [(INTERVALS, ENTRIES), ([], ENTRIES), (INTERVALS, [])]
)
def test_entries_are_lost_from_begin_until_before_the_end(intervals, entries):
    """In one Context whose time goes on, with the derivatives of what passes."""
    system = Dropout(4, intervals, entries)
    converted = system.ToAutoDiffXd()
    context, differentiated = system.CreateDefaultContext(), converted.CreateDefaultContext()
    system.get_input_port().FixValue(context, VALUES)
    converted.get_input_port().FixValue(differentiated, InitializeAutoDiff(VALUES)[:, 0])
    for time in (0.0, 0.24999, 0.25, 0.49999, 0.5, 0.75, 1.0, 1.3, 1.6, 1.99999, 2.0, 100.0):
        lost = np.zeros(4, bool)
        lost[list(entries)] = any(begin <= time < end for begin, end in intervals)
        expected = np.where(lost, math.nan, VALUES)
        context.SetTime(time)
        np.testing.assert_array_equal(system.get_output_port().Eval(context), expected)
        np.testing.assert_array_equal(system.get_input_port().Eval(context), VALUES)
        differentiated.SetTime(time)
        values = converted.get_output_port().Eval(differentiated)
        np.testing.assert_array_equal(ExtractValue(values)[:, 0], expected)
        np.testing.assert_array_equal(ExtractGradient(values), np.diag(1.0 - lost))


def test_bad_loss_is_named():
    for begin, end in ((1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.nan)):
        with pytest.raises(ConfigurationError, match=f"from {begin} to {end} s"):
            Dropout(4, [(0.0, 1.0), (begin, end)], ENTRIES)
    for entry in (-1, 4):
        with pytest.raises(ConfigurationError, match=f"no entry {entry} of 4"):
            Dropout(4, INTERVALS, [0, entry])
