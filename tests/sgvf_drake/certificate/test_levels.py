"""C1 and C2 on levels of V: what is proved is so, and what is refuted is not."""

from dataclasses import replace

from flint import arb
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.certificate.boxes import Answer, Boxes, divide
from sgvf_drake.certificate.levels import (
    HIGH,
    LOW,
    MARGIN,
    RATE,
    SPEED,
    Conditions,
    Decrease,
    Rates,
    Speed,
    prove_levels,
)
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, PaperComposition, Perceptron
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.metrics import grid_starts

from .ball_fields import BallField
from .balls import divided, dot, mixture_at

START = divided(Boxes.square(8.0), 2.0**-4)
SMALLEST = 2.0**-12


@pytest.fixture(scope="module")
def trained(robust_field):
    """A field, V with levels from zero on, and V again as the sampled checks have it."""
    field = robust_field
    mixture = GaussianMixture(field.cloud.normalize(field.mixture.points), field.sigma)
    at = Boxes.points(mixture.points[:1])
    function = LyapunovFunction(mixture)
    offset = MixtureModel(mixture).level_range(at)[0][0] - function(mixture.points[:1])[0]
    return field, MixtureModel(mixture, float(offset)), function


def normalised(field, z):
    return field(field.cloud.denormalize(z))


def inside_of(boxes, rng, count):
    """Random points of random squares, and the numbers of the squares."""
    chosen = rng.integers(len(boxes), size=count)
    steps = rng.uniform(-1, 1, (count, 2)) * boxes.half[chosen, None]
    return boxes.centers[chosen] + steps, chosen


def test_what_is_proved_of_a_band_is_so(trained):
    field, levels, function = trained
    band = (1.0, 6.0)
    found = Decrease(field, levels, *band, alpha=0.05, share=0.5).prove(START, SMALLEST)
    assert found.proved
    known = ~np.isnan(found.facts[:, RATE])
    assert found.evaluated >= known.sum() > 1_000
    z, chosen = inside_of(found.boxes[known], np.random.default_rng(0), 40_000)
    facts = found.facts[known][chosen]
    V, gradient = function.value_and_gradient(z)
    V_dot = (gradient * normalised(field, z)).sum(axis=1)
    rounding = 1e-9
    assert (facts[:, LOW] <= V + rounding).all()
    assert (facts[:, HIGH] >= V - rounding).all()
    in_band = (band[0] <= V) & (band[1] >= V)
    assert (V_dot <= facts[:, RATE] + rounding)[in_band].all()
    speed_inward = -V_dot / np.linalg.norm(gradient, axis=1)
    assert (speed_inward >= facts[:, MARGIN] - rounding)[in_band].all()
    # No square is decided by less than alpha, and than the share of V_dot at its centre.
    centers = found.boxes.centers[known]
    at_centers = function.derivative(centers, normalised(field, centers))
    wanted = -np.maximum(0.05, 0.5 * np.abs(at_centers))
    assert (found.facts[known][:, RATE] <= wanted + 1e-6).all()
    too_fast = Decrease(field, levels, *band, alpha=1e4, share=0.0)
    assert not too_fast.prove(START, SMALLEST).proved
    # Every point of the band is in a square.
    x = np.random.default_rng(1).uniform(-5, 5, (20_000, 2))
    x = x[(function(x) >= band[0]) & (function(x) <= band[1])][:500]
    boxes = found.boxes[known]
    away = np.abs(x[:, None] - boxes.centers).max(axis=2)
    assert (away <= boxes.half).any(axis=1).all()


def in_balls(field, levels, z):
    """V and V_dot at a point, and |m|^2, in ball arithmetic."""
    z = [arb(float(value)) for value in z]
    V, gradient = mixture_at(levels.mixture, z)
    m = BallField(field)(z).m
    return V - arb(levels.lowest), dot(gradient, m), dot(m, m)


def test_the_entry_time_is_the_integral_of_dc_over_the_rate():
    # V falls at the rate V, as its logarithm does at the rate one: slower at the lower level.
    levels = np.geomspace(0.5, 8.0, 2_001)
    found = Rates(levels, alpha=levels[:-1], e_star=levels[:-1], step=1.0)
    assert np.log(16) < found.entry_time < 1.001 * np.log(16)


@pytest.mark.parametrize(
    ("drift", "band"), [(0.0, (0.001, 3.0)), (0.9, (1.0, 6.0))], ids=["too low", "a drift"]
)
def test_a_rate_that_is_not_there_is_refuted_by_a_point(trained, drift, band):
    """On the path V goes on; and a bias of the tangent network carries robots up."""
    field, levels, function = trained
    network = field.tangent_network
    *others, last = network.biases
    biased = replace(network, biases=(*others, np.add(last, [drift, 0.0])))
    planted = replace(field, tangent_network=biased)
    if drift:
        # Without the robust composition, in which a tangent that points outward is taken out.
        planted = replace(planted, composition=PaperComposition(0.02))
    found = Decrease(planted, levels, *band, alpha=0.05, share=0.0).prove(START, SMALLEST)
    assert not found.proved
    V, V_dot, _ = in_balls(planted, levels, found.counterexample)
    assert arb(band[0]) <= V <= arb(band[1])
    assert V_dot > -arb(0.05)
    z = found.counterexample[None]
    expected = function.derivative(z, normalised(planted, z))[0]
    assert float(V_dot) == pytest.approx(expected, rel=1e-6)


@pytest.mark.full
def test_the_tube_is_left_behind_nowhere(trained):
    field, levels, function = trained
    found = Speed(field, levels, 0.1, delta=0.9, share=0.5).prove(START, SMALLEST)
    assert found.proved
    known = ~np.isnan(found.facts[:, SPEED])
    z, chosen = inside_of(found.boxes[known], np.random.default_rng(2), 40_000)
    m = np.linalg.norm(normalised(field, z), axis=1)
    assert (m >= found.facts[known][chosen][:, SPEED] - 1e-9).all()
    x = np.random.default_rng(3).uniform(-5, 5, (200_000, 2))
    assert np.linalg.norm(normalised(field, x[function(x) <= 0.1]), axis=1).min() >= 0.9


def test_a_planted_stop_on_the_path_is_found(trained):
    """A tangent (z_0, 0), which turns around on the line z_0 = 0, across the path."""
    field, levels, _ = trained
    network = Perceptron((np.array([[1.0, 0.0], [0.0, 0.0]]),), (np.zeros(2),))
    planted = replace(field, tangent_network=network)
    found = Speed(planted, levels, 0.5, delta=0.5, share=0.5).prove(START, SMALLEST)
    assert not found.proved
    V, _, square = in_balls(planted, levels, found.counterexample)
    assert arb(0.5) >= V
    assert square < arb(0.5) ** 2


def test_what_cannot_be_decided_is_kept():
    def ask(boxes):
        # Decided is what does not hold a point.
        holds = (np.abs(boxes.centers - 0.3) <= boxes.half[:, None]).all(axis=1)
        return Answer(~holds, np.zeros((len(boxes), 1)), len(boxes))

    def refute(points):
        return np.zeros(len(points), bool)

    found = divide(divided(Boxes.square(1.0), 0.5), ask, refute, 2.0**-6)
    assert not found.proved
    assert found.counterexample is None
    assert len(found.undecided) == 1
    assert found.undecided.half[0] == 2.0**-6
    area = (4 * found.boxes.half**2).sum() + (4 * found.undecided.half**2).sum()
    assert area == 4.0


def function_of(field, levels):
    return LyapunovFunction(GaussianMixture(field.mixture.points, levels.sigma))


def test_robots_enter_the_tube_in_time_and_stay(ring):
    field, _, certificate = ring
    proved = certificate.levels
    V = function_of(field, proved)
    c_in, c_out = proved.conditions.c_in, proved.conditions.c_out
    starts = grid_starts(field.cloud.box, 400, 2)
    level = V(starts)
    starts = starts[(level <= c_out) & (level > c_in)][::8]
    assert len(starts) > 10
    times = np.linspace(0, 3 * proved.entry_time_bound, 200)
    for start in starts:
        found = solve_ivp(lambda _, x: field(x), times[[0, -1]], start, t_eval=times, rtol=1e-8)
        levels = V(found.y.T)
        assert (np.diff(levels[levels > c_in]) < 0).all()
        assert (levels[times >= proved.entry_time_bound] <= c_in).all()


def test_levels_tolerate_what_is_said_and_steps_may_be_so_long(ring):
    field, path, certificate = ring
    proved = certificate.levels
    V = function_of(field, proved)
    x = np.random.default_rng(0).uniform(*field.cloud.box, (40_000, 2))
    level, gradient = V.value_and_gradient(x)
    # Squares that lie in the band, which is less than the band.
    band = ((proved.conditions.c_in <= level) & (level <= proved.conditions.c_out)).mean()
    assert 0.8 * band < proved.decrease_fraction < band
    tube = path.project(x[level <= proved.conditions.c_in]).distance.max()
    assert tube < proved.tube_half_width < tube + 0.5 * field.sigma * field.cloud.unit_length
    inside = (level >= proved.levels[0]) & (level < proved.levels[-1])
    x, level, gradient = x[inside], level[inside], gradient[inside]
    m = field(x)
    inward = -(gradient * m).sum(axis=1) / np.linalg.norm(gradient, axis=1)
    claimed = np.array(proved.e_star)[np.searchsorted(proved.levels, level) - 1]
    assert (inward >= claimed).all()
    assert (V(x + 0.999 * proved.step_bound * m) < level).all()


def test_the_unit_of_the_waypoints_does_not_matter(make_ring, ring):
    own = ring[2].levels
    found = prove_levels(
        *[make_ring(4.0, scale=1000.0)[0], own.conditions], ring[1].rescaled(1e3)
    )
    for name in ("sigma", "tube_half_width", "entry_time_bound", "step_bound"):
        assert getattr(found.levels, name) == pytest.approx(1000 * getattr(own, name), rel=1e-6)
    assert found.levels.alpha == pytest.approx(own.alpha / 1000, rel=1e-6)
    np.testing.assert_allclose(found.levels.e_star, own.e_star, rtol=1e-6)


def test_what_is_not_so_is_told_with_a_place(ring):
    field, path, certificate = ring
    conditions = certificate.levels.conditions
    V = function_of(field, certificate.levels)
    for change, what in (({"alpha": 5.0}, "V falls"), ({"delta": 1.5}, "m is nowhere zero")):
        found = prove_levels(field, replace(conditions, **change), path)
        assert found.levels is None
        assert what in found.reason
        x = field.cloud.denormalize(found.obstacle[None])
        if "alpha" in change:
            unit = field.cloud.unit_length
            assert (V.gradient(x) * field(x)).sum() * unit > -5.0
            assert conditions.c_in <= V(x)[0] <= conditions.c_out
        else:
            assert np.linalg.norm(field(x)) < 1.5
    everything = replace(conditions, c_out=1e3)
    assert "not a set in the square" in prove_levels(field, everything, path).reason


@pytest.mark.parametrize(
    "change",
    [
        *({"alpha": 0.0}, {"alpha": -5.0}, {"delta": 0.0}, {"sigma": 0.0}, {"c_in": 0.0}),
        *({"c_out": 0.0}, {"share": 1.0}, {"share": -0.1}),
        *({"c_out": float("inf")}, {"lowest": float("nan")}, {"sigma": "0.1"}, {"alpha": None}),
    ],
    ids=str,
)
def test_conditions_that_would_say_nothing_are_refused(ring, change):
    """With a speed of zero or an empty band a zero on the path would be no obstacle."""
    conditions = ring[2].levels.conditions
    assert isinstance(conditions, Conditions)
    with pytest.raises(ConfigurationError, match=next(iter(change))):
        replace(conditions, **change)
