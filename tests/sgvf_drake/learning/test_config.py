from dataclasses import asdict, fields
import json

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning import RECIPES, TrainingConfig

# The noise level that the cloud asks for.
SIGMA = 0.13
# What is asked of the path, and not of the learning.
OF_THE_PATH = {"open", "direction", "start"}


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
            for name in (
                "unit_weight",
                "orthogonality_weight",
                "direction_weight",
                "hint_weight",
            )
            for value in (-1e-9, -1, float("nan"), float("inf"), "1", [1.0])
        ),
        *(("num_frequencies", value) for value in (-1, 32.0, "32", (32,), float("nan"))),
        *(
            (name, value)
            for name in ("exact_target", "projection")
            for value in (0, 1, "yes", np.True_)
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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("open", value) for value in (0, 1, "yes", np.True_)),
        *(("direction", value) for value in ("CCW", "", 1, ["ccw", "left"], ("cw", 1))),
        *(("start", value) for value in (1.0, "ab", (0.0, float("nan")), (None, 0.0))),
    ],
)
def test_bad_choices_for_the_path_are_named(name, value):
    with pytest.raises(ConfigurationError, match=rf"^{name} cannot be "):
        TrainingConfig(**{name: value})


def test_choices_for_the_path_are_kept_as_plain_values():
    config = TrainingConfig(open=False, direction=["cw", None], start=np.array([1, 2.5]))
    assert config.open is False
    assert config.direction == ("cw", None)
    assert config.start == (1.0, 2.5)
    assert [type(value) for value in config.start] == [float, float]
    assert TrainingConfig(direction="reverse").direction == "reverse"


@pytest.mark.parametrize("recipe", ["Robust", "", None, 3, ["robust"]])
def test_unknown_recipes_are_told_the_known_ones(recipe):
    with pytest.raises(
        ConfigurationError, match=r"unknown recipe .*choose one of paper, robust, exact"
    ):
        TrainingConfig(recipe=recipe)


@pytest.mark.parametrize("recipe", RECIPES)
def test_resolving_fills_everything(recipe):
    settings = TrainingConfig(recipe=recipe).resolved(SIGMA)
    assert all(value is not None for value in asdict(settings).values())
    names = {f.name for f in fields(TrainingConfig)}
    assert {f.name for f in fields(settings)} == names - OF_THE_PATH
    assert (settings.recipe, settings.seed) == (recipe, 0)


def test_the_papers_values():
    settings = TrainingConfig(recipe="paper").resolved(SIGMA)
    assert settings.score_hidden == (64, 64, 64, 64)
    assert settings.tangent_hidden == (128,)
    assert settings.score_iterations == settings.tangent_iterations == 10_000
    assert (settings.gain, settings.sigma_min, settings.max_restarts) == (0.2, 0.1, 0)


def test_the_losses_of_the_recipes():
    """Those of the paper's Section V-A, and what the design settles for the others."""
    paper = TrainingConfig(recipe="paper").resolved(SIGMA)
    assert paper.weights == {"unit": 1, "orthogonality": 1, "direction": 1, "hint": 0}
    assert (paper.exact_target, paper.num_frequencies, paper.projection) == (False, 0, False)
    for recipe in ("robust", "exact"):
        settings = TrainingConfig(recipe=recipe).resolved(SIGMA)
        weights = {"unit": 0.3, "orthogonality": 1, "direction": 1, "hint": 3}
        assert settings.weights == weights
        assert (settings.num_frequencies, settings.projection) == (32, True)
    assert TrainingConfig().resolved(SIGMA).exact_target is True


@pytest.mark.parametrize(
    ("recipe", "name", "value"),
    [
        ("paper", "hint_weight", 0.0),
        ("paper", "hint_weight", 3.0),
        ("paper", "num_frequencies", 0),
        ("paper", "projection", False),
        ("exact", "exact_target", True),
        ("exact", "exact_target", False),
    ],
)
def test_what_means_nothing_in_a_recipe_is_refused(recipe, name, value):
    """Even where it asks for what the recipe does."""
    with pytest.raises(ConfigurationError, match=f"^{name} is not for the recipe {recipe}, "):
        TrainingConfig(recipe=recipe, **{name: value})


def test_some_loss_is_needed():
    none = dict.fromkeys(("unit_weight", "orthogonality_weight", "direction_weight"), 0)
    with pytest.raises(ConfigurationError, match="every loss of the tangent has weight 0"):
        TrainingConfig(recipe="paper", **none)
    assert TrainingConfig(**none).resolved(SIGMA).weights["hint"] == 3
    with pytest.raises(ConfigurationError, match="every loss of the tangent has weight 0"):
        TrainingConfig(**none, hint_weight=0.0)


def test_the_robust_values_follow_the_cloud():
    settings = TrainingConfig().resolved(SIGMA)
    assert settings.sigma_min == SIGMA
    assert settings.gain == pytest.approx(2 * SIGMA)
    fine = TrainingConfig().resolved(0.05)
    assert fine.sigma_min == 0.05
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
        "num_frequencies": 0,
        "exact_target": False,
        "score_hidden": (8, 9),
        "score_iterations": 11,
        "tangent_hidden": (7,),
        "tangent_iterations": 12,
        "unit_weight": 0.0,
        "orthogonality_weight": 2.5,
        "direction_weight": 0.5,
        "hint_weight": 7.0,
        "projection": False,
    }
    assert asdict(TrainingConfig(**given).resolved(SIGMA)) == given
    assert TrainingConfig(sigma_min=0.3).resolved(SIGMA).gain == pytest.approx(0.6)


def test_numbers_of_numpy_become_plain():
    """They are written as JSON with the field."""
    config = TrainingConfig(
        seed=np.int64(3),
        sigma_min=np.float32(0.25),
        score_hidden=np.array([4, 5]),
        tangent_hidden=[np.int32(6)],
        score_iterations=np.uint8(7),
    )
    settings = config.resolved(SIGMA)
    assert json.loads(json.dumps(asdict(settings)))["score_hidden"] == [4, 5]
    assert settings.tangent_hidden == (6,)
    assert (type(settings.seed), type(settings.sigma_min)) == (int, float)
    assert settings.sigma_min == 0.25


def test_a_restart_grows_what_is_learned_with():
    settings = TrainingConfig(
        score_hidden=(8, 9), tangent_hidden=(7,), score_iterations=11, tangent_iterations=12
    ).resolved(SIGMA)
    assert settings.grown(0) == settings
    first, second = settings.grown(1), settings.grown(2)
    # Half as much again each time, rounded.
    assert np.abs(np.subtract(first.score_hidden, (12, 13.5))).max() <= 0.5
    assert np.abs(np.subtract(first.tangent_hidden, 10.5)).max() <= 0.5
    assert first.score_iterations == pytest.approx(16.5, abs=0.5)
    assert second.score_hidden == (16, 18)
    assert (second.tangent_hidden, second.tangent_iterations) == ((14,), 24)
    assert (second.sigma_min, second.gain) == (settings.sigma_min, settings.gain)
