from dataclasses import asdict, fields
import json

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning import RECIPES, TrainingConfig
from sgvf_drake.learning.scales import CloudScales

SCALES = CloudScales(spacing=0.2, noise=0.0, gap=0.4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1),
        ("seed", 0.5),
        ("seed", 1.0),
        ("seed", "1"),
        ("seed", None),
        ("seed", float("nan")),
        ("max_restarts", -1),
        ("max_restarts", 1.5),
        *(
            (name, value)
            for name in ("sigma_min", "gain", "frequency_std")
            for value in (0.0, -0.1, float("nan"), float("inf"), "0.1", [0.1])
        ),
        *(
            (name, value)
            for name in ("score_iterations", "tangent_iterations")
            for value in (0, -5, 10.0, 10.5, float("inf"), "100")
        ),
        *(
            (name, value)
            for name in ("score_hidden", "tangent_hidden")
            for value in (
                (),
                [],
                64,
                "64",
                (64, 0),
                (64, -1),
                (64, 2.5),
                (64, float("nan")),
                (64, "a"),
                (None,),
            )
        ),
    ],
)
def test_bad_values_are_named(name, value):
    with pytest.raises(ConfigurationError, match=rf"^{name} cannot be "):
        TrainingConfig(**{name: value})


@pytest.mark.parametrize("recipe", ["Robust", "", None, 3, ["robust"]])
def test_unknown_recipes_are_told_the_known_ones(recipe):
    with pytest.raises(
        ConfigurationError, match=r"unknown recipe .*choose one of paper, robust, exact"
    ):
        TrainingConfig(recipe=recipe)


@pytest.mark.parametrize("recipe", RECIPES)
def test_resolving_fills_everything(recipe):
    settings = TrainingConfig(recipe=recipe).resolved(SCALES)
    assert all(value is not None for value in asdict(settings).values())
    assert {f.name for f in fields(settings)} == {f.name for f in fields(TrainingConfig)}
    assert (settings.recipe, settings.seed) == (recipe, 0)


def test_the_papers_values():
    settings = TrainingConfig(recipe="paper").resolved(SCALES)
    assert settings.score_hidden == (64, 64, 64, 64)
    assert settings.tangent_hidden == (128,)
    assert settings.score_iterations == settings.tangent_iterations == 10_000
    assert (settings.gain, settings.sigma_min, settings.max_restarts) == (0.2, 0.1, 0)


def test_the_robust_values_follow_the_cloud():
    settings = TrainingConfig().resolved(SCALES)
    assert settings.sigma_min == pytest.approx(0.65 * 0.2)
    assert settings.gain == pytest.approx(2 * settings.sigma_min)
    fine = TrainingConfig().resolved(CloudScales(spacing=0.01, noise=0.0, gap=0.2))
    assert fine.sigma_min == pytest.approx(0.05)
    # Half the noise level: twice the detail to learn.
    assert fine.frequency_std == pytest.approx(2 * settings.frequency_std)
    assert fine.score_iterations == 2 * settings.score_iterations


def test_what_is_given_is_kept():
    given = {
        "recipe": "robust",
        "seed": 5,
        "max_restarts": 1,
        "sigma_min": 0.3,
        "gain": 0.7,
        "frequency_std": 1.5,
        "score_hidden": (8, 9),
        "score_iterations": 11,
        "tangent_hidden": (7,),
        "tangent_iterations": 12,
    }
    assert asdict(TrainingConfig(**given).resolved(SCALES)) == given
    assert TrainingConfig(sigma_min=0.3).resolved(SCALES).gain == pytest.approx(0.6)


def test_numbers_of_numpy_become_plain():
    """They are written as JSON with the field."""
    config = TrainingConfig(
        seed=np.int64(3),
        sigma_min=np.float32(0.25),
        score_hidden=np.array([4, 5]),
        tangent_hidden=[np.int32(6)],
        score_iterations=np.uint8(7),
    )
    settings = config.resolved(SCALES)
    assert json.loads(json.dumps(asdict(settings)))["score_hidden"] == [4, 5]
    assert settings.tangent_hidden == (6,)
    assert (type(settings.seed), type(settings.sigma_min)) == (int, float)
    assert settings.sigma_min == 0.25
