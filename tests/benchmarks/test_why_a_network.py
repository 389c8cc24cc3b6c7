"""When a learned score pays: the network beside the exact mixture, measured in one run.

Run by `make bench`; the table is printed and saved in build/bench.
"""

from collections.abc import Callable
import time
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sgvf_drake as sgvf
from sgvf_drake.fields import ScoreNetwork

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
SIZES = (200, 2_000, 20_000)
BATCH = 400
REPEATS = 7


def microseconds(call: Callable[[], Any], number: int) -> float:
    """The best of several means, which disturbances of the machine only make longer."""
    means = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        for _ in range(number):
            call()
        means.append((time.perf_counter() - begin) / number)
    return 1e6 * min(means)


def parameters(network: ScoreNetwork) -> int:
    layers = (*network.network.weights, *network.network.biases)
    features = network.network.features
    fourier = () if features is None else (features.frequencies, features.phases)
    return sum(array.size for array in (*layers, *fourier))


def test_network_beside_mixture(save: Save) -> None:
    cloud, _ = sgvf.make_shape("concentric-circles")
    field = sgvf.train(cloud).field
    network = field.score_model
    assert isinstance(network, ScoreNetwork)
    rng = np.random.default_rng(0)
    one, many = rng.uniform(-5, 5, (1, 2)), rng.uniform(-5, 5, (BATCH, 2))
    models: dict[str, tuple[Any, int]] = {"network": (network, parameters(network))}
    for size in SIZES:
        points, _ = sgvf.make_shape("concentric-circles", size)
        mixture = sgvf.GaussianMixture(cloud.normalize(points.points), field.sigma)
        models[f"mixture of {size}"] = (mixture, points.points.size)
    rows = [
        {
            "score": name,
            "numbers stored": size,
            "one value [us]": microseconds(lambda m=model: m.score(one), 50),
            "one Jacobian [us]": microseconds(lambda m=model: m.score_and_jacobian(one), 50),
            f"{BATCH} values [us]": microseconds(lambda m=model: m.score(many), 1),
            f"{BATCH} Jacobians [us]": microseconds(
                lambda m=model: m.score_and_jacobian(many), 1
            ),
        }
        for name, (model, size) in models.items()
    ]
    table = pd.DataFrame(rows).round(1)
    save(table, "why_a_network")
    # The mixture is exact: more waypoints of the same path change its score little, so
    # what is compared is the same thing at another price.
    fine = models["mixture of 2000"][0].score(many)
    finest = models["mixture of 20000"][0].score(many)
    assert np.abs(fine - finest).max() < 0.02 * np.abs(finest).max()
