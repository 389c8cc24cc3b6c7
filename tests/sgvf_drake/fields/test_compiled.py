"""The compiled form of a field is the field, at one point, of which NumPy is another form."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
import os
import subprocess
import sys
from types import SimpleNamespace

from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.registry import CPUDispatcher
import numpy as np
import pytest

from sgvf_drake import compiling
from sgvf_drake.clouds import PointCloud
from sgvf_drake.compiling import digest, timed
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    Composition,
    GaussianMixture,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.compiled.evaluation import SOURCES, evaluate, evaluate_motion
from tests import fields
from tests.fields import RECIPES

COMPOSITIONS = {
    **fields.COMPOSITIONS,
    "resting": RobustComposition(0.8, 0.4, projects=False, tangent_share=0.3),
}
EACH_COMPOSITION = pytest.mark.parametrize(
    "composition", COMPOSITIONS.values(), ids=COMPOSITIONS
)
EACH_ACTIVATION = pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda one: one.name)


def with_activation(field, activation):
    """The field with another activation in its networks."""
    tangent = replace(field.tangent_network, activation=activation)
    score = field.score_model
    if isinstance(score, ScoreNetwork):
        score = replace(score, network=replace(score.network, activation=activation))
    return replace(field, score_model=score, tangent_network=tangent)


def queries(field, n=10, seed=5):
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


@settings(max_examples=40, derandomize=True)
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


@pytest.mark.parametrize("recipe", RECIPES)
@EACH_COMPOSITION
def test_derivatives_along_directions_are_products_with_the_jacobian(
    make_field, recipe, composition
):
    rng = np.random.default_rng(6)
    for dim, ends in product((2, 3), (0, 2)):
        field = replace(make_field(recipe, dim=dim, ends=ends), composition=composition)
        compiled = field.compiled()
        for x in queries(field, n=3):
            flat = compiled.evaluate(x)
            J = flat[dim:].reshape(dim, dim)
            for count in (0, 1, 4):
                directions = rng.standard_normal((count, dim))
                along = compiled.evaluate(x, directions)
                np.testing.assert_array_equal(along[:dim], flat[:dim])
                products = along[dim:].reshape(dim, count)
                atol = 1e-12 * max(1.0, np.abs(J).max())
                np.testing.assert_allclose(products, J @ directions.T, rtol=0, atol=atol)


def test_layers_of_every_width(make_field, make_perceptron):
    """Among them those that are no multiple of what is added at a time, and none at all."""
    rng = np.random.default_rng(2)
    widths = [(), (1,), (5,), (8, 16), (19, 64, 3)]
    for hidden, num_frequencies in product(widths, (0, 1, 13)):
        field = replace(
            make_field("robust"),
            score_model=ScoreNetwork(make_perceptron(rng, 3, hidden, 2, num_frequencies), 0.7),
            tangent_network=make_perceptron(rng, 2, hidden, 2, num_frequencies),
        )
        assert_same(field, queries(field, n=5))


@EACH_COMPOSITION
@pytest.mark.parametrize("part", ["score", "tangent"])
def test_near_a_zero(make_field, composition, part):
    """On both sides of where the series of the squashed score takes over, and at it."""
    field = replace(make_field("robust"), composition=composition)
    zero, score = np.zeros((1, 2)), field.score_model
    if part == "score":
        last = score.network.biases[-1] - score.score(zero)[0] * score.scale
        network = replace(score.network, biases=(*score.network.biases[:-1], last))
        field = replace(field, score_model=replace(score, network=network))
    else:
        network = field.tangent_network
        last = network.biases[-1] - network(zero)[0]
        network = replace(network, biases=(*network.biases[:-1], last))
        field = replace(field, tangent_network=network)
    sizes = np.concatenate([[0.0], np.logspace(-15, -0.5, 30)])
    assert_same(field, field.cloud.denormalize(sizes[:, None] * np.array([0.6, 0.8])))


def test_where_the_score_of_a_mixture_is_exactly_zero(make_field):
    cloud = PointCloud(np.array([[-1.0, 0.0], [1.0, 0.0]]))
    for sigma in (0.4, 3.9, 4.0, 6.0):
        mixture = GaussianMixture(cloud.normalize(cloud.points), sigma)
        field = replace(make_field("exact"), cloud=cloud, sigma=sigma, score_model=mixture)
        assert not field.score(np.zeros(2)).any()
        assert_same(field, [np.zeros(2)])


@EACH_ACTIVATION
def test_saturated_activations_do_not_overflow_and_nan_gives_nan(make_field, activation):
    field = with_activation(make_field("paper"), activation)
    for size in (1e2, 1e3, 1e5, 1e50):
        # The paper has no features, so that the size gets to them.
        x = field.cloud.center + size * np.array([[1.0, 0.3], [-0.2, -1.0]])
        assert np.isfinite([field.compiled().evaluate(point) for point in x]).all()
        assert_same(field, x)
    for recipe, composition in product(RECIPES, COMPOSITIONS.values()):
        field = with_activation(make_field(recipe, dim=3, ends=2), activation)
        compiled = replace(field, composition=composition).compiled()
        for axis in range(3):
            point = field.cloud.center.copy()
            point[axis] = np.nan
            assert np.isnan(compiled.evaluate(point)).all()


def test_infinite_coordinates_give_what_they_give_in_numpy(field):
    for point in ((np.inf, 3.0), (3.0, -np.inf), (np.inf, np.inf)):
        with np.errstate(invalid="ignore"):
            m, J = field.value_and_jacobian(point)
        found = np.isnan(field.compiled().evaluate(point))
        np.testing.assert_array_equal(found, np.isnan(np.concatenate([m, J.ravel()])))


def test_points_of_any_kind(field):
    compiled = field.compiled()
    point = np.array([3.0, 4.0])
    expected = compiled.evaluate(point)
    assert (expected.shape, expected.dtype) == ((6,), np.float64)
    read_only = point.copy()
    read_only.flags.writeable = False
    strided = np.array([[3.0, 0.0], [4.0, 0.0]])[:, 0]
    single, whole = point.astype(np.float32), point.astype(int)
    for other in ((3, 4), [3.0, 4.0], read_only, strided, single, whole):
        np.testing.assert_array_equal(compiled.evaluate(other), expected)
        np.testing.assert_array_equal(compiled(other), expected[:2])
        m, J = compiled.value_and_jacobian(other)
        assert J.shape == (2, 2)
        np.testing.assert_array_equal(np.concatenate([m, J.ravel()]), expected)
    np.testing.assert_array_equal(point, [3, 4])
    assert compiled(np.empty((0, 2))).shape == (0, 2)
    # The result belongs to the caller.
    expected[:] = 0
    assert compiled.evaluate(point).any()


def test_what_cannot_be_compiled_or_evaluated_is_refused(field):
    compiled = field.compiled()
    for shape in [(), (3,), (1,), (4, 3), (0,), (1, 2), (2, 2)]:
        with pytest.raises(ValueError, match=r"expected a position of shape \(2,\), not \("):
            compiled.evaluate(np.zeros(shape))

    class Other(Composition):
        tangent = tangent_and_partial = components = value_and_partials = None

    with pytest.raises(ConfigurationError, match="Other has no compiled form"):
        replace(field, composition=Other(0.2)).compiled()


def test_threads_do_not_share_anything(field):
    compiled, x = field.compiled(), queries(field, n=100)
    expected = [compiled.evaluate(point) for point in x]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(compiled.evaluate, np.tile(x, (5, 1))))
    np.testing.assert_array_equal(found, 5 * expected)
    # One compilation serves all fields.
    assert len(evaluate.signatures) == 1


# What numba costs a process: when it is imported, and when it compiles.

CALLER = """\
import callee
from sgvf_drake.compiling import announced, digest, kernel

def make(sources):
    @kernel
    def answer(x):
        sources
        return callee.part_of_it(x)
    return answer

answer, told = make(digest(callee)), []
with announced(lambda: told.append(True)):
    result = answer(20.0)
print(result, sum(answer.stats.cache_hits.values()), any(told))
"""
CALLEE = """\
from sgvf_drake.compiling import part

@part
def part_of_it(x):
    return x + {}
"""


def output_of(arguments, folder, **environment):
    """What a fresh process prints."""
    run = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
        env=os.environ | environment,
    )
    return run.stdout.split()


def test_the_cache_notices_a_change_in_what_the_kernel_calls(tmp_path):
    """And what is taken from it is not announced as being compiled."""
    (tmp_path / "caller.py").write_text(CALLER)
    answers = []
    for number in (1, 1, 22):
        (tmp_path / "callee.py").write_text(CALLEE.format(number))
        answers.append(output_of(["-B", "caller.py"], tmp_path))
    assert answers == [["21.0", "0", "True"], ["21.0", "1", "False"], ["42.0", "0", "True"]]


def test_where_nothing_can_be_written_it_is_compiled_all_the_same(tmp_path):
    nowhere = tmp_path / "__pycache__"
    nowhere.write_text("a file, so that this is no folder to write to")
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(1))
    environment = {"HOME": str(nowhere), "XDG_CACHE_HOME": str(nowhere)}
    found = output_of(["-B", "caller.py"], tmp_path, **environment)
    assert found == ["21.0", "0", "True"]


def test_a_stopwatch_stands_while_something_is_compiled(monkeypatch):
    """Of five seconds by the clock, two were numba's."""
    readings = iter([10.0, 15.0])

    @contextmanager
    def two_seconds(kind, callback):
        assert kind == "numba:compile"
        yield
        callback(2.0)

    monkeypatch.setattr(compiling.event, "install_timer", two_seconds)
    clock = SimpleNamespace(perf_counter=lambda: next(readings), process_time=lambda: 0.0)
    monkeypatch.setattr(compiling, "time", clock)
    with timed() as watch:
        pass
    assert watch.wall_s == 3.0


def compiled_functions(function, found):
    """The functions that are compiled into one in Python."""
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        if isinstance(callee, CPUDispatcher) and callee.py_func not in found:
            found.add(callee.py_func)
            compiled_functions(callee.py_func, found)
    return found


@pytest.mark.parametrize("kernel", [evaluate, evaluate_motion])
def test_everything_compiled_is_in_the_key_of_the_cache(kernel):
    functions = compiled_functions(kernel.py_func, set())
    assert len(functions) > 10
    sources = {module.__name__ for module in SOURCES}
    # What stands in the file of the kernel is in the key anyway.
    assert {f.__module__ for f in functions} <= sources | {kernel.py_func.__module__}
    (enclosed,) = kernel.py_func.__closure__
    assert enclosed.cell_contents == digest(*SOURCES)
