"""What a training is asked to do: the recipes' values, and what is refused."""

from dataclasses import asdict, fields
import json

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning import RECIPES, TrainingConfig

# The noise level that the cloud asks for.
SIGMA = 0.13
NAN, INF = float("nan"), float("inf")
BAD_VALUES = {
    ("seed",): (-1, 0.5, 1.0, "1", None, NAN),
    ("max_restarts",): (-1, 1.5),
    ("sigma_min", "gain", "frequency_std"): (0.0, -0.1, NAN, INF, "0.1", [0.1]),
    ("unit_weight", "orthogonality_weight", "direction_weight", "hint_weight"): (
        *(-1e-9, -1, NAN, INF, "1", [1.0]),
    ),
    ("num_frequencies",): (-1, 32.0, "32", (32,), NAN),
    ("exact_target", "projection", "open"): (0, 1, "yes", np.True_),
    ("score_iterations", "tangent_iterations"): (0, -5, 10.0, 10.5, INF, "100"),
    ("score_hidden", "tangent_hidden"): (
        *((), [], 64, "64", (64, 0), (64, -1), (64, 2.5), (64, NAN), (64, "a"), (None,)),
    ),
    ("direction",): ("CCW", "", 1, ["ccw", "left"], ("cw", 1)),
    ("start",): (1.0, "ab", (0.0, NAN), (None, 0.0)),
}
GIVEN = {
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


def test_bad_values_are_named():
    for names, values in BAD_VALUES.items():
        for name in names:
            for value in values:
                with pytest.raises(ConfigurationError, match=rf"^{name} cannot be "):
                    TrainingConfig(**{name: value})
    for recipe in ("Robust", "", None, 3, ["robust"]):
        with pytest.raises(ConfigurationError, match=r"unknown .*one of paper, robust, exact"):
            TrainingConfig(recipe=recipe)


def test_what_means_nothing_in_a_recipe_is_refused():
    """Even where it asks for what the recipe does."""
    for recipe, name, values in (
        ("paper", "hint_weight", (0.0, 3.0)),
        ("paper", "num_frequencies", (0,)),
        ("paper", "projection", (False,)),
        ("exact", "exact_target", (True, False)),
    ):
        for value in values:
            match = f"^{name} is not for the recipe {recipe}, "
            with pytest.raises(ConfigurationError, match=match):
                TrainingConfig(recipe=recipe, **{name: value})
    none = dict.fromkeys(("unit_weight", "orthogonality_weight", "direction_weight"), 0)
    for options in ({"recipe": "paper"}, {"hint_weight": 0.0}):
        with pytest.raises(ConfigurationError, match="every loss of the tangent has weight 0"):
            TrainingConfig(**none, **options)
    assert TrainingConfig(**none).resolved(SIGMA).weights["hint"] == 3


def test_what_is_given_is_kept_as_plain_values():
    assert asdict(TrainingConfig(**GIVEN).resolved(SIGMA)) == GIVEN
    assert TrainingConfig(sigma_min=0.3).resolved(SIGMA).gain == pytest.approx(0.6)
    config = TrainingConfig(open=False, direction=["cw", None], start=np.array([1, 2.5]))
    assert (config.open, config.direction, config.start) == (False, ("cw", None), (1.0, 2.5))
    assert [type(value) for value in config.start] == [float, float]
    assert TrainingConfig(direction="reverse").direction == "reverse"
    # Numbers of NumPy too: they are written as JSON with the field.
    settings = TrainingConfig(
        seed=np.int64(3),
        sigma_min=np.float32(0.25),
        score_hidden=np.array([4, 5]),
        tangent_hidden=[np.int32(6)],
        score_iterations=np.uint8(7),
    ).resolved(SIGMA)
    assert json.loads(json.dumps(asdict(settings)))["score_hidden"] == [4, 5]
    assert settings.tangent_hidden == (6,)
    assert (type(settings.seed), type(settings.sigma_min)) == (int, float)
    assert settings.sigma_min == 0.25


def test_the_values_of_the_recipes():
    """Those of the paper's Section V-A, and what the design settles for the others."""
    options = {f.name for f in fields(TrainingConfig)} - {
        "open",
        "passes",
        "direction",
        "start",
    }
    options -= {"anyway"}
    for recipe in RECIPES:
        settings = TrainingConfig(recipe=recipe).resolved(SIGMA)
        assert {f.name for f in fields(settings)} == options
        assert all(value is not None for value in asdict(settings).values())
        assert (settings.recipe, settings.seed) == (recipe, 0)
        if recipe == "paper":
            assert settings.score_hidden == (64, 64, 64, 64)
            assert settings.tangent_hidden == (128,)
            assert settings.score_iterations == settings.tangent_iterations == 10_000
            found = (settings.gain, settings.sigma_min, settings.max_restarts)
            assert found == (0.2, 0.1, 0)
            weights = {"unit": 1, "orthogonality": 1, "direction": 1, "hint": 0}
            found = (settings.exact_target, settings.num_frequencies, settings.projection)
            assert found == (False, 0, False)
        else:
            weights = {"unit": 0.3, "orthogonality": 1, "direction": 1, "hint": 3}
            found = (settings.exact_target, settings.num_frequencies, settings.projection)
            assert found == (True, 32, True)
            # They follow the cloud; half the noise level has twice the detail to learn.
            assert (settings.sigma_min, settings.gain) == (SIGMA, pytest.approx(2 * SIGMA))
            fine = TrainingConfig(recipe=recipe).resolved(0.05)
            assert fine.frequency_std == pytest.approx(2 * settings.frequency_std)
            assert fine.score_iterations == 2 * settings.score_iterations
        assert settings.weights == weights


def test_a_score_in_space_has_a_larger_network_and_longer_to_learn():
    for recipe in RECIPES:
        config = TrainingConfig(recipe=recipe)
        plane, space = (asdict(config.resolved(SIGMA, dim=dim)) for dim in (2, 3))
        assert plane == asdict(config.resolved(SIGMA))
        others = {name for name, value in plane.items() if space[name] != value}
        if recipe == "robust":
            assert others == {"num_frequencies", "score_hidden", "score_iterations"}
            assert space["score_hidden"] == (128, 128, 128)
        if recipe != "paper":
            assert space["score_iterations"] == 1.5 * plane["score_iterations"]
    assert asdict(TrainingConfig(**GIVEN).resolved(SIGMA, dim=3)) == GIVEN


def test_a_restart_grows_what_is_learned_with():
    settings = TrainingConfig(**GIVEN).resolved(SIGMA)
    assert settings.grown(0) == settings
    first, second = settings.grown(1), settings.grown(2)
    # Half as much again each time, rounded.
    assert np.abs(np.subtract(first.score_hidden, (12, 13.5))).max() <= 0.5
    assert np.abs(np.subtract(first.tangent_hidden, 10.5)).max() <= 0.5
    assert first.score_iterations == pytest.approx(16.5, abs=0.5)
    assert second.score_hidden == (16, 18)
    assert (second.tangent_hidden, second.tangent_iterations) == ((14,), 24)
    assert (second.sigma_min, second.gain) == (settings.sigma_min, settings.gain)
