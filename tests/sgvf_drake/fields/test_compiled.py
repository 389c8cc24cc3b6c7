"""The compiled form of a field is the field, at one point, of which NumPy is another form."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    AdjustableField,
    CompiledField,
    Composition,
    GaussianMixture,
    GuidingField,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.base import CompilableField
from sgvf_drake.fields.compiled.evaluation import evaluate
from sgvf_drake.paths import PointCloud

RECIPES = ("robust", "exact", "paper")
COMPOSITIONS = {
    "paper": PaperComposition(0.8),
    "normalised": NormalisedComposition(0.8),
    "robust": RobustComposition(0.8, 0.4),
    "unprojected": RobustComposition(0.8, 0.4, projects=False),
    "resting": RobustComposition(0.8, 0.4, projects=False, tangent_share=0.3),
}


def with_activation(field, activation):
    """The field with another activation in its networks."""
    tangent = replace(field.tangent_network, activation=activation)
    score = field.score_model
    if isinstance(score, ScoreNetwork):
        score = replace(score, network=replace(score.network, activation=activation))
    return replace(field, score_model=score, tangent_network=tangent)


def queries(field, n=20, seed=5):
    """Positions over the box, on waypoints, beside them, and in the middle."""
    rng = np.random.default_rng(seed)
    waypoints = field.cloud.points[rng.integers(field.cloud.num_points, size=n)]
    beside = waypoints + 0.1 * field.cloud.unit_length * rng.standard_normal(waypoints.shape)
    box = rng.uniform(*field.cloud.box, (n, field.dim))
    return np.concatenate([box, waypoints, beside, [field.cloud.center]])


def assert_same(field, x, tolerance=1e-11):
    """Compares value and Jacobian at every point, relative to the largest entry there."""
    compiled = field.compiled()
    # The last bits of a slope of one, which a saturated activation makes of zero.
    rounding = 1e-15 / field.cloud.unit_length
    for point in x:
        m, J = field.value_and_jacobian(point)
        flat = compiled.evaluate(point)
        scale = max(1.0, np.abs(m).max())
        np.testing.assert_allclose(flat[: field.dim], m, rtol=0, atol=tolerance * scale)
        atol = tolerance * np.abs(J).max() + rounding
        np.testing.assert_allclose(flat[field.dim :].reshape(J.shape), J, rtol=0, atol=atol)


@pytest.mark.parametrize("dim", [2, 3, 4])
@pytest.mark.parametrize("recipe", RECIPES)
def test_value_and_jacobian_are_those_of_numpy(make_field, recipe, dim):
    field = make_field(recipe, dim=dim)
    assert_same(field, queries(field))


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_every_activation(make_field, activation, recipe):
    field = with_activation(make_field(recipe), activation)
    assert_same(field, queries(field))


@pytest.mark.parametrize("ends", [0, 3])
@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("composition", COMPOSITIONS.values(), ids=COMPOSITIONS)
def test_every_composition(make_field, composition, recipe, ends):
    field = replace(make_field(recipe, ends=ends), composition=composition)
    assert_same(field, queries(field))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    recipe=st.sampled_from(RECIPES),
    activation=st.sampled_from(ACTIVATIONS),
    composition=st.sampled_from(list(COMPOSITIONS.values())),
    dim=st.integers(2, 4),
    ends=st.integers(0, 2),
    seed=st.integers(0, 2**32 - 2),
)
def test_every_combination(make_field, recipe, activation, composition, dim, ends, seed):
    field = make_field(recipe, dim=dim, seed=seed, ends=ends, support=7 * (seed % 2))
    field = replace(with_activation(field, activation), composition=composition)
    # Random networks of slopes up to 100, where a zero of the direction may be near.
    assert_same(field, queries(field, n=3, seed=seed), tolerance=1e-9)


@pytest.mark.parametrize("hidden", [(), (1,), (5,), (8, 16), (19, 64, 3)])
@pytest.mark.parametrize("num_frequencies", [0, 1, 13])
def test_layers_of_every_width(make_field, make_perceptron, hidden, num_frequencies):
    """Among them those that are no multiple of what is added at a time, and none at all."""
    rng = np.random.default_rng(2)
    field = replace(
        make_field("robust"),
        score_model=ScoreNetwork(make_perceptron(rng, 3, hidden, 2, num_frequencies), 0.7),
        tangent_network=make_perceptron(rng, 2, hidden, 2, num_frequencies),
    )
    assert_same(field, queries(field))


@pytest.mark.parametrize("ends", [1, 2])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_at_and_around_the_ends(make_field, recipe, dim, ends):
    field = make_field(recipe, dim=dim, ends=ends)
    steps = np.random.default_rng(0).standard_normal((20, 1, dim))
    around = field.ends + field.sigma * field.cloud.unit_length * steps
    x = np.concatenate([field.ends, around.reshape(-1, dim)])
    assert_same(field, x)
    assert_same(field.with_approach_length(5 * field.approach_length), x)


@pytest.mark.parametrize("composition", COMPOSITIONS.values(), ids=COMPOSITIONS)
@pytest.mark.parametrize("part", ["score", "tangent"])
def test_near_a_zero(make_field, composition, part):
    """On both sides of where the series of the squashed score takes over, and at it."""
    field = replace(make_field("robust"), composition=composition)
    zero = np.zeros((1, 2))
    if part == "score":
        network = field.score_model.network
        last = network.biases[-1] - field.score_model.score(zero)[0] * field.score_model.scale
        network = replace(network, biases=(*network.biases[:-1], last))
        field = replace(field, score_model=replace(field.score_model, network=network))
    else:
        network = field.tangent_network
        last = network.biases[-1] - network(zero)[0]
        network = replace(network, biases=(*network.biases[:-1], last))
        field = replace(field, tangent_network=network)
    sizes = np.concatenate([[0.0], np.logspace(-15, -0.5, 60)])
    x = field.cloud.denormalize(sizes[:, None] * np.array([0.6, 0.8]))
    assert_same(field, x)


def test_where_the_score_of_a_mixture_is_exactly_zero(make_field):
    cloud = PointCloud(np.array([[-1.0, 0.0], [1.0, 0.0]]))
    for sigma in (0.4, 3.9, 4.0, 6.0):
        mixture = GaussianMixture(cloud.normalize(cloud.points), sigma)
        field = replace(make_field("exact"), cloud=cloud, sigma=sigma, score_model=mixture)
        assert not field.score(np.zeros(2)).any()
        assert_same(field, [np.zeros(2)])


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("composition", COMPOSITIONS.values(), ids=COMPOSITIONS)
def test_far_away(make_field, composition, recipe, distance):
    """At so many box sizes; the angles of features have lost as many digits there."""
    field = replace(make_field(recipe, ends=1), composition=composition)
    lower, upper = field.cloud.box
    directions = np.array([[1.0, 0.0], [-0.6, 0.8], [0.0, -1.0]])
    x = field.cloud.center + distance * (upper - lower) * directions
    assert np.isfinite([field.compiled().evaluate(point) for point in x]).all()
    # A zero of a network's random direction field makes it a hundred times worse.
    assert_same(field, x, tolerance=1e-11 + 1e-12 * distance)


@pytest.mark.parametrize("size", [1e2, 1e3, 1e5, 1e50])
@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_saturated_activations_do_not_overflow(make_field, activation, size):
    """Without features, so that the size gets to them."""
    field = with_activation(make_field("paper"), activation)
    x = field.cloud.center + size * np.array([[1.0, 0.3], [-0.2, -1.0]])
    assert np.isfinite([field.compiled().evaluate(point) for point in x]).all()
    assert_same(field, x)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_nan_in_any_coordinate_gives_nan(make_field, activation, recipe, dim):
    field = with_activation(make_field(recipe, dim=dim, ends=2), activation)
    for composition in COMPOSITIONS.values():
        compiled = replace(field, composition=composition).compiled()
        for axis in range(dim):
            point = field.cloud.center.copy()
            point[axis] = np.nan
            assert np.isnan(compiled.evaluate(point)).all()


@pytest.mark.parametrize("point", [(np.inf, 3.0), (3.0, -np.inf), (np.inf, np.inf)])
def test_infinite_coordinates_give_what_they_give_in_numpy(field, point):
    with np.errstate(invalid="ignore"):
        m, J = field.value_and_jacobian(point)
    np.testing.assert_array_equal(
        np.isnan(field.compiled().evaluate(point)), np.isnan(np.concatenate([m, J.ravel()]))
    )


@pytest.mark.parametrize("ends", [0, 2])
def test_the_jacobian_is_the_slope_of_the_value(make_field, ends):
    for recipe in RECIPES:
        field = make_field(recipe, dim=3, ends=ends)
        compiled = field.compiled()
        h = 1e-5 * field.cloud.unit_length
        for point in queries(field, n=4):
            _, J = compiled.value_and_jacobian(point)
            numeric = [
                (compiled(point + h * e) - compiled(point - h * e)) / (2 * h) for e in np.eye(3)
            ]
            np.testing.assert_allclose(
                J, np.stack(numeric, axis=1), rtol=0, atol=1e-6 * max(1, np.abs(J).max())
            )


def test_every_entry_gives_the_same(field):
    compiled = field.compiled()
    for point in queries(field, n=3):
        flat = compiled.evaluate(point)
        assert flat.shape == (6,)
        assert flat.dtype == np.float64
        m, J = compiled.value_and_jacobian(point)
        assert J.shape == (2, 2)
        np.testing.assert_array_equal(np.concatenate([m, J.ravel()]), flat)
        np.testing.assert_array_equal(compiled(point), m)


def test_batches_and_the_hessian_are_those_of_the_field(field):
    compiled, x = field.compiled(), queries(field)
    np.testing.assert_array_equal(compiled(x), field(x))
    for ours, theirs in zip(
        compiled.value_and_jacobian(x), field.value_and_jacobian(x), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(compiled.hessian(x), field.hessian(x))
    np.testing.assert_array_equal(compiled.hessian(x[0]), field.hessian(x[0]))
    assert compiled(np.empty((0, 2))).shape == (0, 2)


def test_the_result_belongs_to_the_caller(field):
    compiled, (one, other) = field.compiled(), queries(field)[:2]
    first = compiled.evaluate(one)
    kept = first.copy()
    compiled.evaluate(other)
    np.testing.assert_array_equal(first, kept)
    first[:] = 0
    np.testing.assert_array_equal(compiled.evaluate(one), kept)


def test_points_of_any_kind(field):
    compiled = field.compiled()
    point = np.array([3.0, 4.0])
    expected = compiled.evaluate(point)
    read_only = point.copy()
    read_only.flags.writeable = False
    strided = np.array([[3.0, 0.0], [4.0, 0.0]])[:, 0]
    others = (
        (3, 4),
        [3.0, 4.0],
        read_only,
        strided,
        point.astype(np.float32),
        point.astype(int),
    )
    for other in others:
        np.testing.assert_array_equal(compiled.evaluate(other), expected)
        np.testing.assert_array_equal(compiled(other), expected[:2])
        np.testing.assert_array_equal(compiled.value_and_jacobian(other)[0], expected[:2])
    np.testing.assert_array_equal(point, [3, 4])


@pytest.mark.parametrize("shape", [(), (3,), (1,), (4, 3), (0,), (2, 2, 2)])
@pytest.mark.parametrize("method", ["__call__", "value_and_jacobian", "hessian"])
def test_wrong_shapes_are_refused(field, shape, method):
    with pytest.raises(ValueError, match=r"expected positions of shape \(2,\) or \(n, 2\)"):
        getattr(field.compiled(), method)(np.zeros(shape))


@pytest.mark.parametrize("shape", [(), (3,), (1,), (4, 3), (0,), (1, 2), (2, 2)])
def test_evaluate_takes_one_point(field, shape):
    with pytest.raises(ValueError, match=r"expected a position of shape \(2,\), not \("):
        field.compiled().evaluate(np.zeros(shape))


def test_another_approach_length(make_field):
    for recipe in RECIPES:
        field = make_field(recipe, ends=2)
        compiled = field.compiled()
        wide = compiled.with_approach_length(3 * field.approach_length)
        assert isinstance(wide, CompiledField)
        assert wide.approach_length == pytest.approx(3 * compiled.approach_length)
        other = field.with_approach_length(3 * field.approach_length).compiled()
        for point in queries(field, n=3):
            np.testing.assert_array_equal(wide.evaluate(point), other.evaluate(point))
            assert not np.allclose(wide(point), compiled(point), atol=1e-3)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_bad_lengths_are_refused(field, value):
    with pytest.raises(ConfigurationError, match="length must be a positive number"):
        field.compiled().with_approach_length(value)


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
@pytest.mark.parametrize("recipe", RECIPES)
def test_another_unit_of_length(make_field, recipe, factor):
    field = make_field(recipe, ends=1)
    other = field.rescaled(factor)
    assert_same(other, queries(other))
    compiled, rescaled = field.compiled(), other.compiled()
    for point in queries(field, n=3):
        m, J = compiled.value_and_jacobian(point)
        other_m, other_J = rescaled.value_and_jacobian(factor * point)
        np.testing.assert_allclose(other_m, m, rtol=0, atol=1e-10)
        np.testing.assert_allclose(
            other_J, J / factor, rtol=0, atol=1e-9 * np.abs(J).max() / factor
        )


def test_fields_imported_from_torch(make_sequential):
    cloud = PointCloud(np.random.default_rng(0).uniform(-20, 30, (40, 2)))
    for normalise in (False, True):
        field = GuidingField.from_torch(
            make_sequential([3, 16, 16, 2], "GELU"),
            make_sequential([2, 9, 2], "Softplus", seed=1),
            cloud,
            normalise=normalise,
        )
        assert_same(field, queries(field))


def test_it_is_a_field(field):
    compiled = field.compiled()
    assert isinstance(field, CompilableField)
    assert isinstance(compiled, AdjustableField)
    assert compiled.field is field
    assert compiled.cloud is field.cloud
    assert compiled.dim == field.dim
    assert compiled.approach_length == field.approach_length


def test_a_composition_of_another_kind_is_refused(make_field):
    class Other(Composition):
        tangent = tangent_and_partial = components = value_and_partials = None

    field = replace(make_field("robust"), composition=Other(0.2))
    with pytest.raises(ConfigurationError, match="Other has no compiled form"):
        field.compiled()


def test_threads_do_not_share_anything(field):
    compiled, x = field.compiled(), queries(field, n=100)
    expected = [compiled.evaluate(point) for point in x]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(compiled.evaluate, np.tile(x, (5, 1))))
    np.testing.assert_array_equal(found, 5 * expected)


def test_one_compilation_serves_all_fields(make_field):
    for dim in (2, 3):
        for recipe in RECIPES:
            make_field(recipe, dim=dim, ends=1).compiled().evaluate(np.zeros(dim))
    assert len(evaluate.signatures) == 1
