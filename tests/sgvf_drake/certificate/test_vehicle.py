"""Responses, second derivatives and the proof of a vehicle: truths, balls and planted flaws."""

from dataclasses import replace
from itertools import permutations, product

from flint import arb, arb_series
import numpy as np
import pytest
from scipy.linalg import expm

from sgvf_drake.certificate import Certificate, responses
from sgvf_drake.certificate.expansions import ACTIVATIONS, COSINE, SINE
from sgvf_drake.certificate.flown_field import FlownBounds, flown_facts
from sgvf_drake.certificate.jet_model import JetModel, jet_field, jet_network
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.responses import respond
from sgvf_drake.certificate.vehicle import (
    ErrorBounds,
    VehicleLaw,
    _forces,
    prove_stage,
)
from sgvf_drake.certificate.vehicle_claim import VehiclePiece, VehicleProposal, VehicleResult
from sgvf_drake.exceptions import ConfigurationError

from .balls import FUNCTIONS, point_of, random_patch, vector

LAW = VehicleLaw(
    *(0.45, 3.0, 12.0, 0.7, 0.46, 9.81, (4.5e-4, 6e-4, 8.5e-4), 0.0745, 0.008, 4.625),
    *(2.0, 1.0, 0.001, 1.22, 0.1, 0.75, 0.9, 10.0, 100.0, 0.78),
)
"""The paper's quadrotor at 0.45 m/s."""

BOUNDS = FlownBounds(0.184, 0.00108, 20.1, 1.0, 1.07, 30.7, 1.49, 3.52, 5.34, 1.001, 1)
"""Those of a ring of 1 m, in a field that turns to it at 4 1/s; U = 0.5 m."""

START = ErrorBounds(0.03, 0.005, 0.005, 0.03)
HELD = ErrorBounds(0.08, 0.02, 0.022, 0.21)


def stage(law=LAW, start=START, held=HELD, bounds=BOUNDS, disturbance=0.01):
    return prove_stage(law, start, held, bounds, 0.5, disturbance)


def test_a_flight_within_its_bounds_is_proved():
    proof = stage()
    assert proof.failures == ()
    for name, value in vars(proof.final).items():
        assert value < getattr(HELD, name)
    # What is proved to be left is what the causes make, but for rounding.
    assert proof.final.velocity <= sum(proof.causes.values()) * 1.01


@pytest.mark.parametrize(
    ("flaw", "words"),
    [
        ({"law": replace(LAW, velocity_gain=-3.0)}, "not stable"),
        ({"law": replace(LAW, bandwidth=6.0)}, ""),
        ({"law": replace(LAW, max_force=1.15)}, "force of a propeller"),
        ({"law": replace(LAW, inertia=(0.1, 0.1, 0.1))}, "propeller"),
        (
            {"law": replace(LAW, inertia=(0.1, 0.1, 0.1), max_force=100.0)},
            "no force of a propeller",
        ),
        ({"law": replace(LAW, max_tilt=0.03)}, "tilt of the demanded thrust"),
        ({"law": replace(LAW, max_heading_error=0.05)}, "turn from the heading"),
        ({"law": replace(LAW, max_rate=0.5)}, "desired body rate"),
        ({"law": replace(LAW, max_angular_acceleration=10.0)}, "desired angular acceleration"),
        ({"law": replace(LAW, look=0.002)}, "how far the law looks"),
        ({"law": replace(LAW, look=0.0001)}, "desired angular acceleration"),
        ({"bounds": replace(BOUNDS, error=0.1)}, "velocity error against"),
        ({"bounds": replace(BOUNDS, along_off=9.0)}, "bound of attitude"),
        ({"bounds": replace(BOUNDS, bend_off=90.0)}, "bound of attitude"),
        ({"bounds": replace(BOUNDS, along_change=5.0)}, "desired angular acceleration"),
        ({"start": replace(START, velocity=0.09)}, "bound of velocity"),
        ({"start": replace(START, climb=0.03)}, "bound of climb"),
        ({"start": replace(START, attitude=0.03)}, "bound of attitude"),
        ({"held": replace(HELD, rate=0.05)}, "bound of rate"),
        ({"held": replace(HELD, attitude=0.8, rate=8.0)}, "sine of the attitude error"),
        ({"disturbance": 0.3}, "bound of velocity"),
    ],
)
def test_planted_flaws_are_refused(flaw, words):
    failures = stage(**flaw).failures
    assert failures
    assert words in "; ".join(failures)


@pytest.mark.parametrize("inertia", [*permutations(LAW.inertia)])
def test_no_propeller_needs_more_than_the_bounds_of_its_force(inertia):
    """The torque is J alpha + w x J w, which the arms and the yaw drag of four share."""
    law, (slow, fast) = replace(LAW, inertia=inertia), (0.9, 1.1)
    (bend, spin), (tip, turn) = (9.0, 4.0), (20.0, 20.0)
    least, most = _forces(law, (slow, fast), (bend, spin), np.hypot(tip, turn))
    J, forces = np.array(inertia), []
    sides = np.exp(1j * np.pi / 8 * np.arange(16))
    for lift, a, about, w, yaw in product(
        (slow, fast), bend * sides, (-spin, spin), tip * sides, (-turn, turn)
    ):
        rate = np.array([w.real, w.imag, yaw])
        torque = J * [a.real, a.imag, about] + np.cross(rate, J * rate)
        roll, pitch = torque[:2] / (2 * law.arm_length)
        drag = torque[2] / (4 * law.yaw_arm)
        mean = lift * law.mass * law.gravity / 4
        forces += [mean - pitch + drag, mean + pitch + drag]
        forces += [mean - roll - drag, mean + roll - drag]
    assert least <= min(forces)
    assert max(forces) <= most
    assert most - least < 4 * (max(forces) - min(forces))


def test_what_is_left_when_a_response_is_no_longer_followed_counts(monkeypatch):
    monkeypatch.setattr(responses, "TIMES", 0.1)
    monkeypatch.setattr(responses, "BLOCK", 4)
    found = respond(np.array([[-2.0]]), np.array([[1.0]]), np.array([[3.0]]), 1.0)
    assert found.integral[0, 0] >= 1.5
    assert found.late[0, 0] >= 3 * np.exp(-2)


def test_responses_are_just_above_the_true_ones():
    """Of a loop with a pair of complex poles, by another integration of finer steps."""
    A = np.array([[-3.0, 1, 0], [-12, 4, 1], [0, -144, -16.8]])
    outputs = np.array([[1.0, 0, 0], [-3, 1, 0]])
    found = respond(A, np.eye(3), outputs, 2.0)
    times, h = np.linspace(0, 12, 120001, retstep=True)
    values = np.empty((len(times), 2, 3))
    step, state = expm(A * h), np.eye(3)
    for number in range(len(times)):
        values[number] = outputs @ state
        state = step @ state
    size = np.abs(values)
    integral = h * (size[1:] + size[:-1]).sum(axis=0) / 2
    for bound, true in (
        (found.integral, integral),
        (found.peak, size.max(axis=0)),
        (found.late, size[times >= 2].max(axis=0)),
    ):
        assert np.all(bound >= true * (1 - 1e-9))
    np.testing.assert_allclose(found.integral, integral, rtol=0.02)
    np.testing.assert_allclose(found.peak, size.max(axis=0), rtol=0.02)


def test_a_first_order_lag_has_the_responses_of_the_formula():
    found = respond(np.array([[-2.0]]), np.array([[1.0]]), np.array([[3.0]]), 1.0)
    assert 1.5 <= found.integral[0, 0] < 1.501
    assert 3.0 <= found.peak[0, 0] < 3.001
    assert 3 * np.exp(-2) <= found.late[0, 0] < 3.2 * np.exp(-2)


def test_what_is_not_stable_has_no_responses():
    assert respond(np.array([[0.1]]), np.eye(1), np.eye(1), 1.0) is None


@pytest.mark.parametrize("name", ["SiLU", "Tanh", "sine", "cosine"])
def test_second_derivatives_are_inside_of_their_expansions(name):
    function = {"sine": SINE, "cosine": COSINE}.get(name) or ACTIVATIONS[name]
    rng = np.random.default_rng(0)
    u = rng.uniform(-8, 8, 300)
    reach = 10.0 ** rng.uniform(-6, 0.5, 300)
    for order, expand in ((1, function.expand_slope), (2, function.expand_curvature)):
        found = expand(*(ends[None] for ends in (u, u - reach, u + reach)))
        for row, share in enumerate(rng.uniform(-1, 1, 300)):
            t = float(share * reach[row])
            x = arb(float(u[row])) + arb(t)
            series = FUNCTIONS[name](arb_series([x, 1], prec=3))
            true = series[order] * order
            told = arb(float(found.value[0, row])) + arb(float(found.slope[0, row])) * arb(t)
            told += arb(float(found.curvature[0, row])) * arb(t) ** 2 / 2
            assert abs(true - told) <= arb(float(found.rest[0, row]))


def test_the_higher_derivatives_of_silu_are_below_their_bounds():
    for low in np.linspace(-40, 40, 4000, endpoint=False):
        x = arb(low + 0.01, 0.0101)
        around = FUNCTIONS["SiLU"](arb_series([x, 1], prec=7))
        middle = FUNCTIONS["SiLU"](arb_series([arb(low + 0.01), 1], prec=6))
        fourth, fifth = ACTIVATIONS["SiLU"].bounds
        assert abs(middle[5] * 120) + arb(0.0101) * abs(around[6] * 720) < fifth
        assert abs(middle[4] * 24) + arb(0.0101) * fifth < fourth


def second(function, z, a, b):
    """d^2 f / dz_a dz_b of balls, by power series along three directions."""
    along = []
    for direction in ({a: 1, b: 1} if a != b else {a: 1}, {a: 1}, {b: 1}):
        moved = [arb_series([x, direction.get(k, 0)], prec=3) for k, x in enumerate(z)]
        along.append([2 * value[2] for value in function(moved)])
    if a == b:
        return along[0]
    return [(whole - one - two) / 2 for whole, one, two in zip(*along, strict=True)]


def plain_network(network, z, held):
    """The outputs of a network for power series of balls."""
    rows = [*z, *held]
    if network.features is not None:
        d = network.features.frequencies.shape[1]
        angles = [
            sum((arb(float(w)) * x for w, x in zip(row, rows[:d], strict=True)), arb(float(p)))
            for row, p in zip(
                network.features.frequencies, network.features.phases, strict=True
            )
        ]
        rows = [x.sin() for x in angles] + [x.cos() for x in angles] + rows[d:]
    for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        rows = [
            sum((arb(float(w)) * x for w, x in zip(row, rows, strict=True)), arb(float(b)))
            for row, b in zip(weight, bias, strict=True)
        ]
        if number < len(network.weights) - 1:
            rows = [FUNCTIONS[network.activation.name](x) for x in rows]
    return rows


@pytest.mark.parametrize("half", [0.3, 0.02, 1e-4])
@pytest.mark.parametrize("hidden", [(7,), (6, 5, 4)])
def test_second_derivatives_of_a_network_are_inside_of_their_models(
    make_perceptron, half, hidden
):
    rng = np.random.default_rng(3)
    network = make_perceptron(rng, 3, hidden, 2, num_frequencies=4)
    held = vector([0.7])
    for _ in range(4):
        patch = random_patch(rng, half, 2, 2)
        jet = jet_network(network, patch, (0.7,))
        for u in [np.zeros(2), *rng.uniform(-1, 1, (3, 2)), np.array([1.0, -1.0])]:
            z = point_of(patch, u)
            for model, (a, b) in zip(jet.second, [(0, 0), (0, 1), (1, 1)], strict=True):
                true = second(lambda x: plain_network(network, x, held), z, a, b)
                for k, value in enumerate(true):
                    assert arb(float(model.lower[0, k])) <= value
                    assert value <= arb(float(model.upper[0, k]))


def test_second_derivatives_of_a_field_are_those_of_its_hessian(make_field):
    field, rng = make_field("robust"), np.random.default_rng(0)
    z = rng.uniform(-4, 4, (40, 2))
    jet = jet_field(field, Patches(z, np.full((40, 2, 2), 1e-4) * np.eye(2)))
    H = field.hessian(field.cloud.denormalize(z)) * field.cloud.unit_length**2
    for model, (a, b) in zip(jet.second, [(0, 0), (0, 1), (1, 1)], strict=True):
        assert np.all(model.lower <= H[:, :, a, b] + 1e-9)
        assert np.all(H[:, :, a, b] <= model.upper + 1e-9)
        np.testing.assert_allclose(model.value, H[:, :, a, b], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("half", [0.02, 1e-3])
def test_what_a_field_asks_is_within_its_bounds(make_field, half):
    """Against differences of the field itself along many velocities, from all over patches."""
    field, rng, error, reach = make_field("robust"), np.random.default_rng(0), 0.2, 0.004
    unit = field.cloud.unit_length
    patches = Patches(rng.uniform(-2, 2, (6, 2)), half * rng.normal(size=(6, 2, 2)))
    facts = flown_facts(field, patches, error, reach)
    for _ in range(60):
        u = rng.uniform(-1, 1, (6, 2))
        z = patches.centers + np.einsum("njk,nk->nj", patches.axes, u)
        m = field(field.cloud.denormalize(z))
        s = rng.normal(size=(6, 2))
        n = m + error * rng.uniform() * s / np.linalg.norm(s, axis=1)[:, None]
        h = reach / max(1.0, np.linalg.norm(n, axis=1).max())
        x = [field.cloud.denormalize(z + sign * h * n) for sign in (-1, 0, 1)]
        U, J = zip(*(field.value_and_jacobian(place) for place in x), strict=True)
        J, H = [unit * one for one in J], unit**2 * field.hessian(x[1])
        along = np.einsum("nijk,nj,nk->ni", H, n, n)
        second = (U[0] - 2 * U[1] + U[2]) / h**2
        third = np.einsum("nij,nj->ni", J[0] - 2 * J[1] + J[2], n) / h
        matrix = np.einsum("nijk,nk->nij", H, n) - (J[2] - J[0]) / (2 * h)
        speed = np.linalg.norm(m, axis=1)
        true = [along, second - along, third, H, matrix, np.einsum("nij,nj->ni", J[1], n)]
        true = [np.linalg.norm(one.reshape(6, -1), axis=1) for one in true]
        true[4] /= np.linalg.norm(n, axis=1)
        slope = np.linalg.norm(J[1], 2, axis=(1, 2))
        assert np.all(np.transpose([*true, slope]) <= facts[:, :7] + 1e-6)
        assert np.all(speed <= facts[:, 7])


def test_products_of_jets_follow_the_rule_of_leibniz():
    patch = Patches(np.array([[0.3, -0.7]]), 1e-9 * np.eye(2)[None])
    x = JetModel.position(patch)
    both = x * x
    np.testing.assert_allclose(both.second[0].value, [[2, 0]], atol=1e-12)
    np.testing.assert_allclose(both.second[2].value, [[0, 2]], atol=1e-12)
    np.testing.assert_allclose(x.dot(x).second[1].value, [[0]], atol=1e-12)


def test_a_score_in_closed_form_is_refused(make_field):
    with pytest.raises(ConfigurationError, match="robust and paper"):
        jet_field(make_field("exact"), Patches(np.zeros((1, 2)), 0.01 * np.eye(2)[None]))


def claimed(**changes):
    proposal = VehicleProposal(1, 0.184, 0.001, 1.07, START, HELD)
    piece = VehiclePiece(
        proposal,
        (),
        half_width=0.05,
        altitude_error=0.01,
        velocity_error=0.055,
        tolerated=0.06,
        progress=0.3,
        final=HELD,
        settling=24.0,
        tilt=0.03,
        tilt_demanded=0.05,
        forces=(1.0, 1.2),
        causes={"differences": 0.02},
        patches=7,
    )
    result = VehicleResult(LAW, 1.0, 0.01, (replace(piece, **changes), None))
    return Certificate(True, "", "digest", vehicle=result)


def test_what_is_claimed_of_a_vehicle_is_read_as_it_was_written():
    assert Certificate.from_json(claimed().to_json()) == claimed()


def test_what_has_no_bound_is_read_too():
    """A piece along which the field is not bounded; JSON has no infinity."""
    proposal = VehicleProposal(1, 0.184, 0.001, 1.07, START, HELD)
    piece = VehiclePiece(proposal, ("the field is not proved to bend as proposed",))
    result = VehicleResult(LAW, 1.0, 0.01, (piece,))
    found = Certificate(True, "", "digest", vehicle=result)
    assert Certificate.from_json(found.to_json()) == found
    unbounded = replace(found, area_fraction=np.inf)
    with pytest.raises(ValueError, match="JSON"):
        unbounded.to_json()


@pytest.mark.parametrize(
    "changes", [{"velocity_error": 0.054}, {"tolerated": 0.07}, {"half_width": 0.04}]
)
def test_more_than_is_proved_of_a_vehicle_is_refused(changes):
    assert claimed().is_as_strong_as(claimed())
    assert not claimed().is_as_strong_as(claimed(**changes))
    assert not replace(claimed(), vehicle=None).is_as_strong_as(claimed())
    assert not claimed(failures=("one",)).is_as_strong_as(claimed())
