"""What a field costs: classical beside learned, and a learned score beside the exact one."""

import timeit

import numpy as np
import pytest

import sgvf_drake as sgvf
from sgvf_drake.fields import GuidingField, ParametricField
import sgvf_drake.learning
from sgvf_drake.paper.methods import CASES, DIRECTED, METHODS, make_case

from .measuring import timed

pytestmark = pytest.mark.benchmark

MANY = 400


def microseconds(function, x, number=50):
    """The best of several means, which disturbances of the machine only make longer."""
    return 1e6 * min(timeit.repeat(lambda: function(x), number=number, repeat=7)) / number


def test_time_to_build_and_time_of_a_value(save):
    """All on the ordered waypoints of one smooth curve."""
    cloud, _ = make_case(CASES["ordered"], 0)
    x = np.random.default_rng(0).uniform(*cloud.box, (MANY, 2))

    def build(method):
        """The field, and where it is evaluated: at the first place already here."""
        field = method.build(cloud, 0)
        states = field.lift(x) if isinstance(field, ParametricField) else x
        field(states[0])
        return field, states

    rows = []
    for name, method in METHODS.items():
        if name in DIRECTED:
            continue
        (field, states), build_s = timed(lambda method=method: build(method))
        assert np.isfinite(field(states)).all(), method.label
        row = {
            "method": method.label,
            "build_s": build_s,
            "value_us": microseconds(field, states[0]),
            "value_and_jacobian_us": microseconds(field.value_and_jacobian, states[0]),
            "of_many_us": microseconds(field, states, 3) / MANY,
        }
        if isinstance(field, GuidingField):
            evaluate = field.compiled().evaluate
            np.testing.assert_allclose(evaluate(states[0])[:2], field(states[0]), atol=1e-9)
            row["compiled_us"] = microseconds(evaluate, states[0])
        rows.append(row)
    save(rows, "baselines")


def test_network_beside_mixture(save, robust_field):
    cloud, network = robust_field.cloud, robust_field.score_model
    layers = network.network
    stored = (*layers.weights, *layers.biases, layers.features.frequencies)
    size = sum(array.size for array in (*stored, layers.features.phases))
    models = {"network": (network, size)}
    for size in (200, 2_000, 20_000):
        points, _ = sgvf.make_shape("concentric-circles", size)
        mixture = sgvf.GaussianMixture(cloud.normalize(points.points), robust_field.sigma)
        models[f"mixture of {size}"] = (mixture, points.points.size)
    rng = np.random.default_rng(0)
    one, many = rng.uniform(-5, 5, (1, 2)), rng.uniform(-5, 5, (MANY, 2))
    rows = [
        {
            "score": name,
            "numbers stored": size,
            "one value [us]": microseconds(model.score, one),
            "one Jacobian [us]": microseconds(model.score_and_jacobian, one),
            f"{MANY} values [us]": microseconds(model.score, many, 1),
            f"{MANY} Jacobians [us]": microseconds(model.score_and_jacobian, many, 1),
        }
        for name, (model, size) in models.items()
    ]
    save(rows, "why_a_network")
    # The mixture is exact: more waypoints of the same path change its score little, so
    # what is compared is the same thing at another price.
    fine = models["mixture of 2000"][0].score(many)
    finest = models["mixture of 20000"][0].score(many)
    assert np.abs(fine - finest).max() < 0.02 * np.abs(finest).max()
