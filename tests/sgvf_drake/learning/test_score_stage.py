from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import find_activation
from sgvf_drake.learning import SelfCheck, TrainingConfig, train, training
from sgvf_drake.learning.self_check import Fault, PieceCheck

PASSED = SelfCheck((PieceCheck(1.0, True, 12, 12, ()),))
FAILED = SelfCheck((PieceCheck(1.0, True, 12, 11, (Fault("stall", (0.0, 0.0)),)),))


def short(**overrides):
    """A training that exercises everything and learns little."""
    return TrainingConfig(
        **{"score_iterations": 30, "tangent_iterations": 30, "max_restarts": 0, **overrides}
    )


@pytest.fixture
def unchecked(monkeypatch):
    monkeypatch.setattr(training, "check_field", lambda field, support: PASSED)


def bits(network):
    return b"".join(array.tobytes() for array in (*network.weights, *network.biases))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("exact_target", [True, False])
@pytest.mark.parametrize("recipe", ["robust", "paper"])
def test_a_given_score_is_kept_and_the_tangent_is_that_of_both(
    concentric, recipe, exact_target
):
    config = short(recipe=recipe, seed=5, exact_target=exact_target)
    both = train(concentric[0], config).field
    before = bits(both.score_model.network)
    told = []
    result = train(
        concentric[0], config, lambda *call: told.append(call[0]), score=both.score_model
    )
    assert result.history["stage"].unique().tolist() == ["tangent"]
    assert set(told) == {"tangent"}
    assert "score" not in result.history.columns
    assert result.field.score_model is both.score_model
    assert bits(both.score_model.network) == before
    assert bits(result.field.tangent_network) == bits(both.tangent_network)
    assert result.field.provenance["score"] == "given"
    assert "score" not in both.provenance


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "paper"])
def test_the_tangent_is_learned_on_the_given_score(concentric, recipe):
    config = short(recipe=recipe)
    first = train(concentric[0], config).field.score_model
    turned = replace(first, network=_turned(first.network))
    fields = [train(concentric[0], config, score=score).field for score in (first, turned)]
    tangents = [np.concatenate([w.ravel() for w in f.tangent_network.weights]) for f in fields]
    assert (tangents[0] != tangents[1]).mean() > 0.9


def _turned(network):
    """The network with its outputs turned by a right angle."""
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    weights = (*network.weights[:-1], turn @ network.weights[-1])
    biases = (*network.biases[:-1], turn @ network.biases[-1])
    return replace(network, weights=weights, biases=biases)


def test_every_attempt_has_the_given_score(concentric, monkeypatch):
    score = train(concentric[0], short()).field.score_model
    rest, seen = [FAILED, PASSED], []

    def check(field, support):
        seen.append(field)
        return rest.pop(0)

    monkeypatch.setattr(training, "check_field", check)
    result = train(concentric[0], short(max_restarts=2), score=score)
    assert result.restarts == 1
    assert [field.score_model for field in seen] == [score, score]
    assert bits(seen[0].tangent_network) != bits(seen[1].tangent_network)


def test_a_score_that_does_not_fit_is_refused(concentric, make_field):
    cloud, _ = concentric
    score = make_field("robust").score_model
    with pytest.raises(ConfigurationError, match=r"^score is not for the recipe exact"):
        train(cloud, short(recipe="exact"), score=score)
    with pytest.raises(
        ConfigurationError, match=r"^score must be a ScoreNetwork, not GaussianMixture"
    ):
        train(cloud, short(), score=make_field("exact").score_model)
    with pytest.raises(
        ConfigurationError, match=r"^score has 4 inputs and 3 outputs.* 3 and 2"
    ):
        train(cloud, short(), score=make_field("robust", dim=3).score_model)
    network = replace(score.network, activation=find_activation("Tanh"))
    with pytest.raises(ConfigurationError, match=r"^score has the activation Tanh"):
        train(cloud, short(), score=replace(score, network=network))
