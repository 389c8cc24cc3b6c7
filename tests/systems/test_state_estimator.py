"""The estimator against the theory of its filter, and what it makes of lost samples."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
import pytest
from scipy.linalg import solve_discrete_lyapunov

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import StateEstimator
from systems.state_estimator import DEFAULT_BANDWIDTH

from .flying import differences

PERIOD = 0.01
DELAY = 0.03
DIRECTION = np.array([0.5, -1.0, 2.0])
START = np.array([0.3, 1.2, -0.7])
LOST = np.full(3, math.nan)


class Filter:
    """An estimator with its Context, sample by sample."""

    def __init__(self, delay=0.0, bandwidth=DEFAULT_BANDWIDTH, period=PERIOD, scalar=float):
        self.period = period
        self.system = StateEstimator(period, delay, bandwidth)
        if scalar is not float:
            self.system = self.system.ToAutoDiffXd()
        self.context = self.system.CreateDefaultContext()
        self.samples = 0

    @property
    def time(self):
        """When the next sample is taken, in s."""
        return self.samples * self.period

    def set(self, position, velocity):
        """Sets the estimate in place of the next sample."""
        self.context.SetTime(self.time)
        self.samples += 1
        self.system.SetEstimate(self.context, position, velocity)

    def step(self, measured, acceleration=None):
        """Takes the next sample, at its time."""
        self.context.SetTime(self.time)
        self.samples += 1
        self.fix("measured_position", measured)
        if acceleration is not None:
            self.fix("acceleration", acceleration)
        update = self.system.EvalUniquePeriodicDiscreteUpdate(self.context)
        self.context.SetDiscreteState(update)

    def fix(self, name, value):
        self.system.GetInputPort(name).FixValue(self.context, value)

    def output(self, name):
        return self.system.GetOutputPort(name).Eval(self.context)

    @property
    def position(self):
        return self.output("position")

    @property
    def velocity(self):
        return self.output("velocity")

    @property
    def age(self):
        return self.output("measurement_age")[0]


def error_dynamics(bandwidth, period=PERIOD):
    """A (2, 2) and B (2,) of (position, velocity) of one axis, as the system itself steps.

    The estimate is x <- A x + B z for a measured position z.
    """

    def image(position, velocity, measured):
        found = Filter(0.0, bandwidth, period)
        found.set([0.0, position, 0.0], [0.0, velocity, 0.0])
        found.step([0.0, measured, 0.0])
        assert found.position[[0, 2]].any() == found.velocity[[0, 2]].any() == 0
        return [found.position[1], found.velocity[1]]

    return np.column_stack([image(1, 0, 0), image(0, 1, 0)]), np.array(image(0, 0, 1))


@pytest.mark.parametrize("bandwidth", [1.0, DEFAULT_BANDWIDTH, 200.0])
@pytest.mark.parametrize("period", [0.002, PERIOD])
def test_both_poles_are_where_they_should_be(bandwidth, period):
    A, B = error_dynamics(bandwidth, period)
    pole = math.exp(-bandwidth * period)
    # A double eigenvalue is known to the root of the rounding, the polynomial to all of it.
    np.testing.assert_allclose(np.linalg.eigvals(A), pole, atol=1e-6)
    np.testing.assert_allclose(np.poly(A), [1.0, -2.0 * pole, pole**2], atol=1e-12)
    # A constant position is measured as what it is.
    np.testing.assert_allclose(A @ [1.0, 0.0] + B, [1.0, 0.0], atol=1e-14)


@pytest.mark.parametrize(("bandwidth", "delay"), [(DEFAULT_BANDWIDTH, DELAY), (60.0, 0.0)])
def test_noise_of_the_estimates_is_that_of_the_lyapunov_equation(bandwidth, delay):
    A, B = error_dynamics(bandwidth)
    covariance = solve_discrete_lyapunov(A, np.outer(B, B))
    pole = math.exp(-bandwidth * PERIOD)
    # The variances of the fading-memory filter, as they stand in textbooks.
    textbook = [
        (1 - pole) * (1 + 4 * pole + 5 * pole**2) / (1 + pole) ** 3,
        2 * (1 - pole) ** 3 / (1 + pole) ** 3 / PERIOD**2,
    ]
    np.testing.assert_allclose(np.diag(covariance), textbook, rtol=1e-9)
    for row, name in (((1.0, delay), "position"), ((0.0, 1.0), "velocity")):
        C = np.array(row)
        variance = C @ covariance @ C
        count, settled = 2000, 200
        # Bartlett: the variance of a sample variance of a Gaussian process is 2/n sum rho^2.
        lags = [C @ np.linalg.matrix_power(A, k) @ covariance @ C for k in range(1, 200)]
        effective = 3 * count / (1.0 + 2.0 * np.square(np.array(lags) / variance).sum())
        rng = np.random.default_rng(0)
        found = Filter(delay, bandwidth)
        found.set(np.zeros(3), np.zeros(3))
        values = []
        for _ in range(settled + count):
            found.step(rng.standard_normal(3))
            values.append(found.output(name))
        ratio = np.square(values[settled:]).mean() / variance
        assert abs(ratio - 1.0) < 4.0 * math.sqrt(2.0 / effective)


def test_default_bandwidth_gives_a_velocity_good_to_a_centimetre_a_second():
    A, B = error_dynamics(DEFAULT_BANDWIDTH)
    deviation = 1e-3 * math.sqrt(solve_discrete_lyapunov(A, np.outer(B, B))[1, 1])
    assert 0.005 < deviation < 0.01


def follow(found, motion, delay, duration=2.0, acceleration=None):
    """Feeds the positions of a motion, and returns the time of the last sample in s."""
    while found.time < duration:
        time = found.time
        found.step(motion(time - delay), acceleration)
    return time


@pytest.mark.parametrize("acceleration", [np.zeros(3), DIRECTION[::-1]])
@pytest.mark.parametrize("delay", [0.0, PERIOD, DELAY])
def test_motion_of_known_acceleration_is_followed_without_error(delay, acceleration):
    found = Filter(delay)
    t = follow(
        found,
        lambda t: START + t * DIRECTION + 0.5 * t**2 * acceleration,
        delay,
        acceleration=acceleration,
    )
    expected = START + t * DIRECTION + 0.5 * t**2 * acceleration
    np.testing.assert_allclose(found.position, expected, atol=1e-11)
    np.testing.assert_allclose(found.velocity, DIRECTION + t * acceleration, atol=1e-11)
    assert found.age == delay


@pytest.mark.parametrize("delay", [0.0, DELAY])
@pytest.mark.parametrize("bandwidth", [10.0, DEFAULT_BANDWIDTH])
def test_velocity_lags_in_a_turn_if_the_acceleration_is_not_known(bandwidth, delay):
    found = Filter(delay, bandwidth)
    t = follow(found, lambda t: 0.5 * t**2 * DIRECTION, delay, duration=6.0)
    lag = t * DIRECTION - found.velocity
    # Exactly, and to first order in the period.
    seconds = PERIOD * (1.0 / math.tanh(0.5 * bandwidth * PERIOD) - 0.5) + delay
    np.testing.assert_allclose(lag, seconds * DIRECTION, rtol=1e-9)
    assert seconds - delay == pytest.approx(2.0 / bandwidth, abs=0.51 * PERIOD)


def test_lost_samples_are_bridged_by_prediction():
    found = Filter(DELAY)

    def motion(t):
        return START + t * DIRECTION + 0.5 * t**2 * DIRECTION[::-1]

    t = follow(found, motion, DELAY, acceleration=DIRECTION[::-1])
    for lost in range(1, 21):
        # One value that is not finite is enough.
        measured = motion(t + lost * PERIOD - DELAY)
        measured[lost % 3] = (math.nan, math.inf)[lost % 2]
        found.step(measured)
        assert found.age == pytest.approx(DELAY + lost * PERIOD, abs=1e-12)
        np.testing.assert_allclose(found.position, motion(t + lost * PERIOD), atol=1e-11)
    found.step(motion(t + 21 * PERIOD - DELAY))
    assert found.age == DELAY
    np.testing.assert_allclose(found.position, motion(t + 21 * PERIOD), atol=1e-11)


# Lost ones, and what a delay holds at the start.
@pytest.mark.parametrize("nothing", [LOST, np.zeros(3)])
def test_first_sample_after_the_delay_starts_it(nothing):
    found = Filter(DELAY)
    for k in range(3):
        found.step(nothing)
        assert found.age == pytest.approx(DELAY + k * PERIOD)
    np.testing.assert_array_equal(found.velocity, 0.0)
    found.step(START)
    np.testing.assert_array_equal(found.position, START)
    np.testing.assert_array_equal(found.velocity, 0.0)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_estimate_can_be_set_at_any_time_between_samples(share):
    found = Filter(DELAY)
    follow(found, lambda t: np.zeros(3), DELAY, duration=0.1)
    # At a sample too: a simulation that has come to its time has not taken it yet.
    time = found.time - share * PERIOD
    found.context.SetTime(time)
    found.system.SetEstimate(found.context, START, DIRECTION)
    found.step(START + (found.time - time - DELAY) * DIRECTION)
    np.testing.assert_allclose(found.position, START + share * PERIOD * DIRECTION, atol=1e-14)
    np.testing.assert_allclose(found.velocity, DIRECTION, atol=1e-12)


def test_acceleration_that_is_not_finite_is_named_with_the_time():
    found = Filter()
    found.step(START, DIRECTION)
    found.step(START, DIRECTION)
    message = r"input port 'acceleration' is not finite at t = 0\.02 s"
    with pytest.raises(NonFiniteValueError, match=message):
        found.step(START, [0.0, math.nan, 0.0])


@pytest.mark.parametrize("measured", [START, LOST])
def test_derivatives_through_samples_agree_with_differences(measured):
    """By the estimate at the start, a sample, the acceleration, bandwidth and delay."""

    def outputs(found, x):
        system, context = found.system, found.context
        system.SetDelay(context, x[13])
        found.set(x[0:3], x[3:6])
        system.SetBandwidth(context, x[12])
        found.step(x[6:9], x[9:12])
        found.step(measured, x[9:12])
        return np.concatenate([found.position, found.velocity])

    x = np.concatenate([START, DIRECTION, START + 0.1, DIRECTION[::-1], [20.0, DELAY]])
    differentiated = outputs(Filter(scalar="autodiff"), InitializeAutoDiff(x)[:, 0])
    np.testing.assert_allclose(
        ExtractValue(differentiated)[:, 0], outputs(Filter(), x), rtol=1e-12
    )
    expected = differences(lambda x: outputs(Filter(), x), x, 1e-5)
    assert np.all(np.abs(expected).max(axis=0) > 1e-4)
    np.testing.assert_allclose(ExtractGradient(differentiated), expected, atol=1e-7)


@pytest.mark.parametrize("name", ["period", "delay", "bandwidth"])
def test_bad_arguments_are_named(name):
    found = Filter()
    for bad in (-1.0, math.nan, math.inf, *([] if name == "delay" else [0.0])):
        with pytest.raises(ConfigurationError, match=rf"{name} .* {bad}"):
            StateEstimator(**{"period": PERIOD, name: bad})
        if name != "period":
            with pytest.raises(ConfigurationError, match=rf"{name} .* {bad}"):
                getattr(found.system, f"Set{name.title()}")(found.context, bad)
