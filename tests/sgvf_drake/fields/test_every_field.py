"""What every field keeps to, learned or classical: a registry of fields, and one test each."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    AdjustableField,
    AlgebraicCurve,
    CompiledField,
    CurveField,
    Field,
    FourierCurve,
    GaussianMixture,
    ImplicitField,
    LagrangeCurve,
    ParametricField,
    PursuitField,
    ScoreNetwork,
    load_field,
)
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.base import CompilableField
from tests.fields import COMPOSITIONS, RECIPES


def learned(recipe, activation=None, composition=None, **options):
    """Makes an untrained field of the form of a recipe."""

    def make(make_field):
        field = make_field(recipe, **options)
        if composition is not None:
            field = replace(field, composition=composition)
        if activation is not None:
            network = replace(field.tangent_network, activation=activation)
            field = replace(field, tangent_network=network)
        return field

    return make


LEARNED = {
    **{recipe: learned(recipe) for recipe in RECIPES},
    **{f"{recipe} in space": learned(recipe, dim=3) for recipe in RECIPES},
    **{
        f"{recipe} with {ends} ends in {dim}-D": learned(recipe, dim=dim, ends=ends, support=12)
        for recipe, ends, dim in product(("robust", "exact"), (1, 2), (2, 3))
    },
    **{
        f"{recipe}, {name}": learned(recipe, composition=composition)
        for recipe, (name, composition) in product(("robust", "exact"), COMPOSITIONS.items())
    },
    **{f"tangent of {one.name}": learned("paper", activation=one) for one in ACTIVATIONS},
}


def flower(n=60, waves=3):
    """Waypoints on a curve that is not convex, in order."""
    angle = 2 * np.pi * np.arange(n) / n
    radius = 30 * (1 + 0.3 * np.cos(waves * angle))
    return PointCloud(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def curve_field(kind, order, closed):
    cloud = flower()
    return lambda: CurveField(cloud, [kind.through(cloud, order, closed)], gain=2.0)


def parametric(cloud):
    return ParametricField(cloud, FourierCurve.through(cloud), gain=2.0)


def in_space():
    plane = flower(30, waves=2).points
    return PointCloud(np.column_stack([plane, plane[:, 0] * plane[:, 1] / 30]))


CLASSICAL = {
    "pursuit": lambda: PursuitField(flower()),
    "implicit": lambda: ImplicitField(flower(), AlgebraicCurve.fit(flower()), gain=2.0),
    "Fourier": curve_field(FourierCurve, np.arange(0, 60, 5), True),
    "Fourier, open": curve_field(FourierCurve, np.arange(8, 20), False),
    "Lagrange": curve_field(LagrangeCurve, np.arange(0, 60, 5), True),
    "Lagrange, open": curve_field(LagrangeCurve, np.arange(8, 20), False),
    "parametric": lambda: parametric(flower()),
    "parametric in space": lambda: parametric(in_space()),
}


@pytest.fixture(params=[*LEARNED, *CLASSICAL])
def any_field(request, make_field):
    name = request.param
    return LEARNED[name](make_field) if name in LEARNED else CLASSICAL[name]()


@pytest.fixture(params=LEARNED)
def learned_field(request, make_field):
    return LEARNED[request.param](make_field)


def queries(field, n=8):
    """Positions over the box, beside waypoints, and at and around the ends."""
    rng, cloud = np.random.default_rng(5), field.cloud
    box = rng.uniform(*cloud.box, (n, cloud.dim))
    beside = cloud.points[rng.integers(cloud.num_points, size=n)]
    beside = beside + 0.1 * cloud.unit_length * rng.standard_normal(beside.shape)
    around = field.ends + field.sigma * cloud.unit_length * rng.standard_normal(cloud.dim)
    if isinstance(field, ParametricField):
        w = rng.uniform(0, field.curve.length * cloud.unit_length, 2 * n)
        return np.column_stack([np.concatenate([box, beside]), w])
    if isinstance(field, CurveField):
        # Off the medial axis of the curve, across which the nearest point jumps.
        w = np.linspace(0.1, 0.9, n) * field.curves[0].length
        c = field.curves[0].derivatives(w, 0)[0]
        return cloud.denormalize(c + rng.uniform(-0.15, 0.15, c.shape))
    if isinstance(field, ImplicitField):
        # Where the gradient of phi vanishes, the field turns at once.
        slope = np.linalg.norm(field.phi.gradient(cloud.normalize(box)), axis=1)
        return np.concatenate([box[slope > 0.3], beside])
    return np.concatenate([box, beside, field.ends, around])


def test_a_field_has_the_derivatives_of_its_value(any_field):
    """By central differences; and one point, a batch and none are evaluated alike."""
    field, x = any_field, queries(any_field)
    assert isinstance(field, Field)
    h, d = 1e-5 * field.cloud.unit_length, field.dim
    m, J = field.value_and_jacobian(x)
    H = field.hessian(x)
    np.testing.assert_allclose(m, field(x), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(H, np.swapaxes(H, 2, 3), atol=1e-11 * np.abs(H).max())
    ahead, behind = ([field.value_and_jacobian(x + s * e) for e in np.eye(d)] for s in (h, -h))
    for order, exact in ((0, J), (1, H)):
        numeric = [(a[order] - b[order]) / (2 * h) for a, b in zip(ahead, behind, strict=True)]
        atol = 1e-6 * max(1 / field.cloud.unit_length ** (order + 1), np.abs(exact).max())
        np.testing.assert_allclose(exact, np.stack(numeric, axis=-1), atol=atol)
    # BLAS sums one row in another order than many.
    one, one_J = field.value_and_jacobian(x[1])
    np.testing.assert_allclose(one, m[1], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(one_J, J[1], rtol=1e-8, atol=1e-10 * np.abs(J).max())
    np.testing.assert_allclose(
        field.hessian(x[1]), H[1], rtol=1e-6, atol=1e-9 * np.abs(H).max()
    )
    none = x[:0]
    assert (field(none).shape, field.hessian(none).shape) == ((0, d), (0, d, d, d))
    assert field.value_and_jacobian(none)[1].shape == (0, d, d)
    for shape in [(), (d + 1,), (1,), (4, d + 1), (0,), (2, 2, d)]:
        for method in (field, field.value_and_jacobian, field.hessian):
            with pytest.raises(
                ValueError, match=rf"expected .* of shape \({d},\) or \(n, {d}\)"
            ):
                method(np.zeros(shape))


def test_a_field_in_another_unit_and_of_another_approach_length(learned_field):
    """m is a direction and keeps its value; J is per length, H per length squared."""
    field, x = learned_field, queries(learned_field)
    m, J = field.value_and_jacobian(x)
    H = field.hessian(x)
    for factor in (1000.0, 1e-3):
        other = field.rescaled(factor)
        other_m, other_J = other.value_and_jacobian(factor * x)
        np.testing.assert_allclose(other_m, m, rtol=1e-9, atol=1e-11)
        # Times the power of the factor they are those of before.
        for found, exact in ((factor * other_J, J), (factor**2 * other.hessian(factor * x), H)):
            atol = 1e-8 * np.abs(exact).max()
            np.testing.assert_allclose(found, exact, rtol=1e-6, atol=atol)
        np.testing.assert_allclose(other.score(factor * x), field.score(x) / factor, rtol=1e-9)
        np.testing.assert_allclose(other.tangent(factor * x), field.tangent(x), rtol=1e-9)
        np.testing.assert_allclose(other.ends, factor * field.ends, rtol=1e-15)
        assert other.approach_length == pytest.approx(factor * field.approach_length)
        assert other.mixture.sigma == pytest.approx(factor * field.mixture.sigma)
    assert isinstance(field, AdjustableField)
    assert field.approach_length == pytest.approx(0.4**2 / 0.8 * field.cloud.unit_length)
    wide = field.with_approach_length(3 * field.approach_length)
    assert type(wide) is type(field)
    assert wide.approach_length == pytest.approx(3 * field.approach_length)
    assert wide.composition == replace(field.composition, gain=wide.composition.gain)
    assert field.composition.gain == 0.8, "the field itself is left as it was"
    np.testing.assert_array_equal(wide.score(x), field.score(x))
    np.testing.assert_array_equal(wide.tangent(x), field.tangent(x))
    assert not np.allclose(wide(x), field(x), atol=1e-3)
    for value in (0.0, -1.0, np.nan, np.inf):
        for each in (field, field.compiled()):
            with pytest.raises(ConfigurationError, match="length must be a positive number"):
                each.with_approach_length(value)
        with pytest.raises(ConfigurationError, match="scale must be a positive number"):
            field.rescaled(value)


def test_the_compiled_form_is_the_field_near_and_far(learned_field):
    field = learned_field
    compiled = field.compiled()
    assert isinstance(field, CompilableField)
    assert isinstance(compiled, AdjustableField)
    assert (compiled.field, compiled.cloud, compiled.dim) == (field, field.cloud, field.dim)
    wide = compiled.with_approach_length(3 * field.approach_length)
    assert isinstance(wide, CompiledField)
    x = queries(field, n=4)
    lower, upper = field.cloud.box
    direction = (upper - lower) * np.linspace(-0.6, 0.8, field.dim)
    for distance in (0, 1e2, 1e4, 1e6):
        # So many box sizes away; the angles of features have lost as many digits there.
        points = field.cloud.center + distance * direction[None] if distance else x
        tolerance = 1e-11 + 1e-12 * distance
        for ours, theirs in (
            (compiled, field),
            (wide, field.with_approach_length(3 * field.approach_length)),
        ):
            assert ours.approach_length == theirs.approach_length
            for point in points:
                m, J = theirs.value_and_jacobian(point)
                assert np.isfinite(theirs.hessian(point)).all()
                found, slope = ours.value_and_jacobian(point)
                np.testing.assert_array_equal(ours(point), found)
                atol = tolerance * max(1.0, np.abs(m).max())
                np.testing.assert_allclose(found, m, rtol=0, atol=atol)
                # The last bits of a slope of one, which a saturated activation makes of zero.
                atol = tolerance * np.abs(J).max() + 1e-15 / field.cloud.unit_length
                np.testing.assert_allclose(slope, J, rtol=0, atol=atol)
    for method in ("__call__", "value_and_jacobian", "hessian"):
        ours, theirs = (getattr(one, method)(x) for one in (compiled, field))
        for one, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(one, other)


def bits(field):
    """The bytes of all that was learned, and of all points."""
    score = field.score_model
    networks = [field.tangent_network]
    networks += [score.network] if isinstance(score, ScoreNetwork) else []
    arrays = [array for n in networks for array in (*n.weights, *n.biases)]
    for features in (n.features for n in networks if n.features is not None):
        arrays += [features.frequencies, features.phases]
    arrays += [score.points] if isinstance(score, GaussianMixture) else []
    arrays += [p for p in (field.support, field.end_points) if p is not None]
    return [array.tobytes() for array in arrays]


def test_saved_and_loaded_a_field_is_the_same_to_the_bit(learned_field, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    none = replace(learned_field, end_points=learned_field.cloud.points[:0])
    for field in (learned_field, learned_field.rescaled(2.0), none):
        field.save(first, overwrite=True)
        loaded = load_field(str(first))
        assert bits(loaded) == bits(field)
        for method in ("__call__", "value_and_jacobian", "hessian"):
            ours, theirs = (getattr(one, method)(queries(field)) for one in (loaded, field))
            for one, other in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(one, other)
        for name in ("composition", "sigma", "recipe", "seed", "provenance"):
            assert getattr(loaded, name) == getattr(field, name)
        for name in ("support", "end_points"):
            assert (getattr(loaded, name) is None) == (getattr(field, name) is None)
        activation = field.tangent_network.activation
        assert loaded.tangent_network.activation is activation
        clouds = [(each.cloud.digest, each.cloud.shape) for each in (loaded, field)]
        assert clouds[0] == clouds[1]
        loaded.save(second, overwrite=True)
        assert second.read_bytes() == first.read_bytes()
