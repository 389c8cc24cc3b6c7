"""The closed loop of QuadrotorPlant and the SE(3) law against the equations of the proof."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sgvf_drake.certificate.flown_jerk import FlownBounds
from sgvf_drake.certificate.vehicle import ErrorBounds, Linear, feed
from sgvf_drake.experiments.certified import as_flown
from sgvf_drake.experiments.vehicle_search import vehicle_law
from sgvf_drake.fields import load_guiding_field
from systems import QuadrotorParameters
from systems.controller import DEFAULT_GAINS
from systems.guidance import ALTITUDE_GAIN, MAX_CLIMB_RATE, _CalcCommands
from systems.quadrotor import NUM_PROPELLERS
from systems.se3_law import (
    CalcAttitude,
    CalcDesiredAttitude,
    CalcPropellerInput,
    CalcTurnRate,
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

    def commands(self, p, v):
        m, J = self.field.value_and_jacobian(p[None, :2])
        field = np.concatenate([m[0], J[0].ravel()])
        found = _CalcCommands(field, p, v, self.speed, ALTITUDE, np.empty(6))
        return found[:3], found[3:]

    def rate(self, state):
        U, a = self.commands(state[:3], state[6:9])
        force = CalcPropellerInput(
            *(state, U, a, np.zeros(3), DEFAULT_GAINS, BODY, PARAMETERS.rotors, G, False)
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

    def desired(self, p, v):
        U, a = self.commands(p, v)
        q = a - K * (v - U) + G * UP
        w = np.array(CalcTurnRate(v, a))
        j = np.cross(w, a)
        R, omega, alpha = CalcDesiredAttitude(q, j, np.cross(w, j), 0.0, False)
        return U, a, q, np.column_stack(R), np.array(omega), np.array(alpha)

    def errors(self, state):
        """e in W, q, R, e_R and beta, and the desired rates."""
        U, _, q, R_d, omega, alpha = self.desired(state[:3], state[6:9])
        columns, body_rate = CalcAttitude(tuple(state[3:6]), tuple(state[9:]))
        R = np.column_stack(columns)
        E = R_d.T @ R
        e_R = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
        return state[6:9] - U, q, R, e_R, np.array(body_rate) - R.T @ omega, omega, alpha

    def linear_state(self, state):
        """The parts across the thrust of e, rho and sigma, in the body frame; and the yaw."""
        e, _, R, e_R, beta, *_ = self.errors(state)
        across = [(R.T @ e)[:2], G * np.cross(e_R, UP)[:2], G * np.cross(beta, UP)[:2]]
        return np.array(across), np.array([e_R[2], beta[2]])

    def derivative(self, function, state):
        ends = [function(self.later(state, sign * STEP)) for sign in (1, -1)]
        return [(a - b) / (2 * STEP) for a, b in zip(*ends, strict=True)]

    def state(self, rng, error, attitude, rate):
        """A state near the path with errors of about these sizes."""
        points = self.field.path.pieces[0]
        p = np.append(points.at(rng.uniform(0, points.length, 1))[0], ALTITUDE)
        p += rng.normal(size=3) * [0.05, 0.05, 0.01]
        U, _ = self.commands(p, np.zeros(3))
        v = U + error * rng.normal(size=3) * [1, 1, 0.2]
        _, _, _, R_d, omega, _ = self.desired(p, v)
        R = R_d @ Rotation.from_rotvec(attitude * rng.normal(size=3)).as_matrix()
        yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX")
        w = R.T @ omega + rate * rng.normal(size=3)
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        turning = np.linalg.solve([[1, 0, -sp], [0, cr, cp * sr], [0, -sr, cp * cr]], w)
        return np.concatenate([p, [roll, pitch, yaw], v, turning])


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


def test_the_attitude_errors_obey_their_equations(loop, states):
    k_w = 2 * DEFAULT_GAINS.damping_ratio * WN
    for state in states:
        _, _, R, e_R, beta, _, alpha = loop.errors(state)
        R_d = loop.desired(state[:3], state[6:9])[3]
        turning, beta_rate, omega_rate = loop.derivative(
            lambda x: [
                loop.desired(x[:3], x[6:9])[3],
                loop.errors(x)[4],
                loop.errors(x)[5],
            ],
            state,
        )
        xi = R.T @ (alpha - omega_rate)
        np.testing.assert_allclose(beta_rate, -(WN**2) * e_R - k_w * beta + xi, atol=2e-5)
        # e_R' = E (beta + eps), with eps of the true angular velocity of the desired attitude.
        skew = turning @ R_d.T
        Omega = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        eps = R.T @ (loop.errors(state)[5] - Omega)
        R_e = R_d.T @ R
        E = (np.trace(R_e) * np.eye(3) - R_e.T) / 2
        (change,) = loop.derivative(lambda x: [loop.errors(x)[3]], state)
        np.testing.assert_allclose(change, E @ (beta + eps), atol=1e-6)


def bounds_at(loop, state, centre, unit):
    """What a field asks of a vehicle in one state, in normalised units."""
    p, v, rate = state[:2], state[6:8], loop.speed / unit
    m, J = (part[0] for part in loop.field.value_and_jacobian(p[None]))
    H = loop.field.hessian(p[None])[0] * unit**2
    J, n = unit * J, v / loop.speed
    a = J @ n
    slow = 0.05 / loop.speed
    omega = (n[0] * a[1] - n[1] * a[0]) / (n @ n + slow**2)
    eta = np.einsum("ijk,j,k", H, n, n) + J @ a - omega * np.array([-a[1], a[0]])
    speed = np.linalg.norm(m)
    assert rate > 0
    error = np.linalg.norm(loop.errors(state)[0]) / loop.speed
    return FlownBounds(
        *((1 + 1e-5) * error, centre, np.linalg.norm(eta), np.linalg.norm(a), abs(omega)),
        *(abs(n @ a), np.linalg.norm(J - centre * np.eye(2), 2), np.linalg.norm(J, 2)),
        *(speed, speed, 1),
    )


def test_no_state_feeds_more_than_is_told(loop, states):
    """The rest of the true rates, beside the linear system, in each state by itself."""
    law = vehicle_law(loop.speed, PARAMETERS, DEFAULT_GAINS)
    unit, K_0 = loop.field.cloud.unit_length, 4.0
    centre = (K - K_0) * unit / law.speed
    largest = np.zeros(5)
    for state in states:
        (e, rho, sigma), yaw = loop.linear_state(state)
        whole, q, *_ = loop.errors(state)
        gamma = np.linalg.norm(q) / G
        climb = abs(ALTITUDE - state[2])
        e_z = max(abs(whole[2]), MAX_CLIMB_RATE * math.tanh(ALTITUDE_GAIN * climb) / 1.05)
        sizes = [np.linalg.norm(part) for part in (e, rho, sigma, -K * e + rho)]
        errors = ErrorBounds(*sizes, *np.abs(yaw).tolist(), e_z)
        linear = Linear(1.0, (0.97 * gamma, 1.03 * gamma), K_0)
        force = float(np.linalg.norm(loop.disturbance))
        fed = feed(law, linear, errors, bounds_at(loop, state, centre, unit), unit, force)
        rates, yaw_rates = loop.derivative(loop.linear_state, state)
        d = (loop.errors(state)[2].T @ loop.disturbance)[:2]
        stiffness, damping = WN**2, 2 * 0.7 * WN
        left = [
            np.linalg.norm(rates[0] - (-K * e + rho) - d),
            np.linalg.norm(rates[1] - (-K * K_0 * e + K_0 * rho + sigma) - K_0 * d),
            np.linalg.norm(rates[2] + stiffness * rho + damping * sigma),
            abs(yaw_rates[0] - yaw[1]),
            abs(yaw_rates[1] + stiffness * yaw[0] + damping * yaw[1]),
        ]
        told = [*fed.into[:3], *fed.into[4:]]
        assert np.all(np.array(left) <= np.array(told) + 1e-4)
        largest = np.maximum(largest, np.array(left) / np.array(told))
    # Nor are the bounds idle.
    assert largest[1] > 0.2
    assert NUM_PROPELLERS == 4
