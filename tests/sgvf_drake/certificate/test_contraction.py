"""Rates at which orbits come together, and balls of rest."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

from sgvf_drake.certificate.contraction import rate_across, rate_of_distances
from sgvf_drake.certificate.field_model import PerturbedField
from sgvf_drake.certificate.rest_ball import RestBall, prove_rest
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.fields import ComposedField


def constant(value, remainder):
    """Models of numbers (n, f) that are known to within others."""
    return TaylorModel(value[:, None], np.broadcast_to(remainder, value.shape).copy())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("off", [0.0, 0.05, 0.5])
def test_rates_are_bounds_for_all_fields_within_the_models(dim, off):
    rng = np.random.default_rng(dim)
    m, J = rng.normal(size=(40, dim)), rng.normal(size=(40, dim, dim)) - 2 * np.eye(dim)
    slopes = tuple(constant(J[:, :, k], off) for k in range(dim))
    dual = DualModel(constant(m, off), slopes)
    across, all_ways = rate_across(dual), rate_of_distances(dual)
    needed = np.full((2, 40), -np.inf)
    for _ in range(60):
        m1 = m + off * rng.choice([-1, 1, rng.uniform(-1, 1)], m.shape)
        J1 = J + off * rng.choice([-1, 1, rng.uniform(-1, 1)], J.shape)
        for i in range(40):
            E = null_space(m1[i : i + 1])
            S = (J1[i] + J1[i].T) / 2
            rate = np.trace(J1[i]) if dim == 2 else np.linalg.eigvalsh(E.T @ S @ E)[-1]
            needed[:, i] = np.maximum(needed[:, i], [rate, np.linalg.eigvalsh(S)[-1]])
    assert (needed[0] <= across + 1e-12).all()
    assert (needed[1] <= all_ways + 1e-12).all()
    if off == 0:
        assert across == pytest.approx(needed[0], abs=1e-6)
        assert all_ways == pytest.approx(needed[1], abs=1e-6)


def test_what_is_not_finite_has_no_rate():
    J = np.full((2, 3, 3), np.nan)
    J[1] = -np.eye(3)
    slopes = tuple(constant(J[:, :, k], 0.0) for k in range(3))
    dual = DualModel(constant(np.ones((2, 3)), 0.0), slopes)
    for rates in (rate_across(dual), rate_of_distances(dual)):
        assert not rates[0] < 0
        assert rates[1] == pytest.approx(-1)


@pytest.mark.parametrize("dim", [2, 3])
def test_cubes_hold_their_ball(dim):
    rng = np.random.default_rng(0)
    ball = RestBall(tuple(rng.uniform(-4, 4, dim)), 0.3)
    u = rng.normal(size=(500, dim))
    points = ball.center + 0.3 * u / np.linalg.norm(u, axis=1, keepdims=True)
    points = np.concatenate(
        [points, ball.center + rng.uniform(0, 1, (500, 1)) * (points - ball.center)]
    )
    cover = ball.cover
    half = cover.axes[0, 0, 0]
    away = np.abs(points[:, None] - cover.centers).max(axis=2)
    assert (away <= half).any(axis=1).all()


@pytest.fixture(scope="module")
def rested(half_circle_field):
    """A field and the place at which orbits of it rest."""
    field = half_circle_field

    def rate(_, z):
        return field(field.cloud.denormalize(z))

    start = field.cloud.normalize(field.path.pieces[0].vertices[0])
    end = solve_ivp(rate, (0, 30), start, rtol=1e-9, atol=1e-12).y[:, -1]
    return field, rate, RestBall(tuple(end.tolist()), 0.03)


def test_orbits_of_a_ball_of_rest_come_together_in_it(rested):
    field, rate, ball = rested
    proof = prove_rest(field, ball)
    assert proof.proved
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    outward = np.column_stack([np.cos(angle), np.sin(angle)])
    border = ball.center + ball.radius * outward
    m = field(field.cloud.denormalize(border))
    assert ((m * outward).sum(axis=1) <= -proof.inflow).all()
    duration = 0.2
    ends = [solve_ivp(rate, (0, duration), z, rtol=1e-9, atol=1e-12).y[:, -1] for z in border]
    distance = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    before = np.linalg.norm(np.diff(border, axis=0), axis=1)
    assert (distance <= before * np.exp(-proof.rate * duration)).all()


def test_other_balls_are_refused(rested):
    field, _, ball = rested
    beside = (ball.center[0] + 2 * ball.radius, ball.center[1])
    for other in (replace(ball, radius=0.3), replace(ball, center=beside)):
        assert not prove_rest(field, other).proved
    backward = replace(field, composition=replace(field.composition, gain=-1.0))
    assert not prove_rest(backward, ball).proved


@dataclass(frozen=True)
class OffBeside(PerturbedField):
    """Functions that are those of a field at a place, and off by as much everywhere else."""

    field: ComposedField
    place: tuple[float, ...]
    off: float

    def error(self, patches):
        at_place = (patches.centers == self.place).all(axis=1) & ~patches.axes.any(axis=(1, 2))
        return np.where(at_place, 0.0, self.off)


def test_the_inflow_is_less_by_the_error_wherever_it_is_largest(rested):
    field, _, ball = rested
    exact = prove_rest(field, ball)
    for share in (0.9, 1.1):
        perturbed = OffBeside(field, ball.center, share * exact.inflow)
        proof = prove_rest(perturbed, ball)
        assert proof.rate == exact.rate
        assert proof.inflow <= (1 - share) * exact.inflow + 1e-12
        assert proof.proved == (share < 1)
