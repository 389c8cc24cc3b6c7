"""The closed loop of QuadrotorPlant and the SE(3) law against the equations of the proof."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sgvf_drake.certificate.flown_field import FlownBounds
from sgvf_drake.certificate.vehicle import ErrorBounds, feed
from sgvf_drake.experiments.certified import as_flown
from sgvf_drake.experiments.vehicle_search import vehicle_law
from sgvf_drake.fields import load_guiding_field
from systems import QuadrotorParameters
from systems.controller import DEFAULT_GAINS
from systems.guidance import (
    ALTITUDE_GAIN,
    DIFFERENCE_TIME,
    MAX_CLIMB_RATE,
    CalcCommandAt,
    CalcDerivatives,
)
from systems.se3_law import (
    CalcAttitude,
    CalcDesiredAttitude,
    CalcPropellerInput,
    CalcThrustRates,
)
from tests.data.make import field_file

PARAMETERS = QuadrotorParameters()
BODY = (PARAMETERS.mass, *PARAMETERS.inertia)
K, WN = DEFAULT_GAINS.velocity_gain, DEFAULT_GAINS.attitude_bandwidth
G = PARAMETERS.gravity
UP = np.array([0, 0, 1.0])
ALTITUDE, SCALE = 1.0, 0.25
# Of central differences along the flow, s.
STEP = 1e-5


class Loop:
    """The loop in continuous time, and the error state of the proof."""

    def __init__(self, speed, disturbance):
        field = load_guiding_field(field_file("robust"))
        self.field = as_flown(field.rescaled(SCALE), speed)
        self.speed, self.disturbance = speed, np.asarray(disturbance)
        plant = PARAMETERS.MakePlant()
        self.plant, self.context = plant, plant.CreateDefaultContext()

    def command(self, p):
        """U and DU at a place."""
        m, J = self.field.value_and_jacobian(p[None, :2])
        field = np.concatenate([m[0], J[0].ravel()])
        return CalcCommandAt(field, p, self.speed, ALTITUDE)

    def commands(self, p, v):
        """U, DU v and the derivatives."""
        places = [self.command(p + h * v) for h in (-DIFFERENCE_TIME, 0.0, DIFFERENCE_TIME)]
        U, DU = places[1]
        return U, DU @ v, CalcDerivatives(places, v)

    def rate(self, state):
        commands = self.commands(state[:3], state[6:9])
        force = CalcPropellerInput(
            *(state, *commands, np.zeros(3), DEFAULT_GAINS, BODY, PARAMETERS.rotors, G, False)
        )
        self.plant.get_input_port().FixValue(self.context, np.array(force))
        self.context.SetContinuousState(state)
        rate = self.plant.EvalTimeDerivatives(self.context).CopyToVector()
        rate[6:9] += self.disturbance
        return rate

    def later(self, state, time):
        """One step of Runge and Kutta's."""
        k1 = self.rate(state)
        k2 = self.rate(state + time / 2 * k1)
        k3 = self.rate(state + time / 2 * k2)
        k4 = self.rate(state + time * k3)
        return state + time / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def thrust(self, p, v):
        """The demanded thrust over the mass."""
        U, a, _ = self.commands(p, v)
        return a - K * (v - U) + G * UP

    def desired(self, state):
        """q, R_d and its rates as the law has them."""
        p, v = state[:3], state[6:9]
        _, a, derivatives = self.commands(p, v)
        q, attitude = self.thrust(p, v), CalcAttitude(tuple(state[3:6]), tuple(state[9:]))
        rates = CalcThrustRates(q, *attitude, a, derivatives, (0.0, 0.0, 0.0), 1.0, K, G)
        R, omega, alpha = CalcDesiredAttitude(q, *rates, 0.0, False)
        return q, np.column_stack(R), np.array(omega), np.array(alpha)

    def errors(self, state):
        """e in W, q, R, e_R and beta, and the desired rates."""
        q, R_d, omega, alpha = self.desired(state)
        e = state[6:9] - self.command(state[:3])[0]
        columns, body_rate = CalcAttitude(tuple(state[3:6]), tuple(state[9:]))
        R = np.column_stack(columns)
        E = R_d.T @ R
        e_R = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
        return e, q, R, e_R, np.array(body_rate) - R.T @ omega, omega, alpha

    def derivative(self, function, state):
        ends = [function(self.later(state, sign * STEP)) for sign in (1, -1)]
        return [(a - b) / (2 * STEP) for a, b in zip(*ends, strict=True)]

    def state(self, rng, error, attitude, rate):
        """A state near the path with errors of about these sizes."""
        points = self.field.path.pieces[0]
        p = np.append(points.at(rng.uniform(0, points.length, 1))[0], ALTITUDE)
        p += rng.normal(size=3) * [0.05, 0.05, 0.01]
        v = self.command(p)[0] + error * rng.normal(size=3) * [1, 1, 0.2]
        R_d, *_ = CalcDesiredAttitude(self.thrust(p, v), (0.0,) * 3, (0.0,) * 3, 0.0, False)
        R = np.column_stack(R_d)
        R = R @ Rotation.from_rotvec(attitude * rng.normal(size=3)).as_matrix()
        yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX")
        level = np.concatenate([p, [roll, pitch, yaw], v])
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        rates = np.array([[1, 0, -sp], [0, cr, cp * sr], [0, -sr, cp * cr]])
        # The desired rate depends on the body's own, weakly: what is asked for is iterated.
        w, wanted = np.zeros(3), rate * rng.normal(size=3)
        for _ in range(20):
            state = np.concatenate([level, np.linalg.solve(rates, w)])
            w = R.T @ self.desired(state)[2] + wanted
        return state


@pytest.fixture(scope="module", params=[0.45, 2.0])
def loop(request):
    return Loop(request.param, [0.3, -0.2, 0.1])


@pytest.fixture
def states(loop):
    rng = np.random.default_rng(0)
    sizes = [(0.01, 0.01, 0.1), (0.1, 0.1, 0.5), (0.3, 0.2, 1.0)]
    return [loop.state(rng, *size) for size in sizes for _ in range(8)]


def test_the_velocity_error_obeys_its_equation(loop, states):
    for state in states:
        e, q, R, *_ = loop.errors(state)
        b = R[:, 2]
        (change,) = loop.derivative(lambda x: [loop.errors(x)[0]], state)
        Delta = (q @ b) * b - q
        np.testing.assert_allclose(change, -K * e + Delta + loop.disturbance, atol=1e-6)


def true_rates(loop, state):
    """e_R' and beta' along the flow, and the true angular velocity of R_d in W."""
    turning, e_R_rate, beta_rate = loop.derivative(
        lambda x: [loop.desired(x)[1], loop.errors(x)[3], loop.errors(x)[4]], state
    )
    skew = turning @ loop.desired(state)[1].T
    return e_R_rate, beta_rate, np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def test_the_attitude_errors_obey_their_equations(loop, states):
    k_w = 2 * DEFAULT_GAINS.damping_ratio * WN
    for state in states:
        _, _, R, e_R, beta, omega, alpha = loop.errors(state)
        e_R_rate, beta_rate, Omega = true_rates(loop, state)
        (omega_rate,) = loop.derivative(lambda x: [loop.errors(x)[5]], state)
        xi = R.T @ (alpha - omega_rate)
        np.testing.assert_allclose(beta_rate, -(WN**2) * e_R - k_w * beta + xi, atol=2e-5)
        # e_R' = E (beta + eps), with eps of the true angular velocity of the desired attitude.
        R_e = loop.desired(state)[1].T @ R
        E = (np.trace(R_e) * np.eye(3) - R_e.T) / 2
        np.testing.assert_allclose(e_R_rate, E @ (beta + R.T @ (omega - Omega)), atol=1e-6)


@pytest.mark.parametrize("speed", [0.45, 2.0])
def test_undisturbed_the_desired_attitude_turns_as_the_law_has_it(speed):
    """But for what differences are off by, the attitude errors depend on nothing else."""
    loop, rng = Loop(speed, [0, 0, 0]), np.random.default_rng(1)
    k_w = 2 * DEFAULT_GAINS.damping_ratio * WN
    for _ in range(8):
        state = loop.state(rng, 0.2, 0.1, 0.5)
        _, _, _, e_R, beta, omega, _ = loop.errors(state)
        _, beta_rate, Omega = true_rates(loop, state)
        np.testing.assert_allclose(omega, Omega, atol=5e-4)
        np.testing.assert_allclose(beta_rate, -(WN**2) * e_R - k_w * beta, atol=5e-3 * speed**3)


def bounds_at(loop, state, unit):
    """What a field asks of a vehicle in one state, in normalised units."""
    p, v, speed = state[:2], state[6:8], loop.speed
    n, reach = v / speed, DIFFERENCE_TIME * np.linalg.norm(v) / unit
    places = [p + share * DIFFERENCE_TIME * v for share in np.linspace(-1, 1, 41)]
    m, J = (part[0] for part in loop.field.value_and_jacobian(p[None]))
    H = loop.field.hessian(np.array(places)) * unit**2
    along = np.einsum("pijk,j,k->pi", H, n, n)
    sizes = np.linalg.norm(along, axis=1), np.linalg.norm(H.reshape(41, -1), axis=1)
    off = along - along[20], (H - H[20]).reshape(41, -1)
    off, bend_off = (np.linalg.norm(one, axis=1).max() for one in off)
    error = np.linalg.norm(loop.errors(state)[0][:2]) / speed
    size = np.linalg.norm(m)
    more = 1 + 1e-5
    return FlownBounds(
        *(more * error, more * max(reach, DIFFERENCE_TIME * speed / unit)),
        *(sizes[0].max(), off, 2 * off, sizes[1].max(), bend_off),
        *(unit * np.linalg.norm(J @ n), unit * np.linalg.norm(J, 2), size, 1),
    )


def test_no_state_feeds_more_than_is_told(loop, states):
    """The rest of the true rates, beside the linear system, in each state by itself."""
    law = vehicle_law(loop.speed, PARAMETERS, DEFAULT_GAINS)
    unit, k_w = loop.field.cloud.unit_length, 2 * DEFAULT_GAINS.damping_ratio * WN
    largest = np.zeros(3)
    for state in states:
        e, q, R, e_R, beta, omega, alpha = loop.errors(state)
        climb = MAX_CLIMB_RATE * math.tanh(ALTITUDE_GAIN * abs(ALTITUDE - state[2])) / 1.05
        sizes = [np.linalg.norm(e[:2]), max(abs(e[2]), climb)]
        errors = ErrorBounds(*sizes, np.linalg.norm(e_R), np.linalg.norm(beta))
        force = float(np.linalg.norm(loop.disturbance))
        fed = feed(law, errors, bounds_at(loop, state, unit), unit, force)
        e_R_rate, beta_rate, _ = true_rates(loop, state)
        Delta = (q @ R[:, 2]) * R[:, 2] - q
        left = [
            np.linalg.norm(e_R_rate - beta),
            np.linalg.norm(beta_rate + WN**2 * e_R + k_w * beta),
            np.linalg.norm(Delta + loop.disturbance),
        ]
        told = [fed.attitude, fed.rate, K * fed.velocity]
        assert np.all(np.array(left) <= np.array(told) + 1e-4)
        assert np.linalg.norm(q) <= fed.thrust
        largest = np.maximum(largest, np.array(left) / np.array(told))
        if not any("body rate" in one or "angular" in one for one in fed.failures):
            assert np.linalg.norm(omega) < law.max_rate
            assert np.linalg.norm(alpha) < law.max_angular_acceleration
    # Nor are the bounds idle.
    assert np.all(largest > 0.1)
