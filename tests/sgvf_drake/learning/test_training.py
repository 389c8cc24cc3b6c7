"""Training, from a cloud to a field: each recipe anew once, and what short runs can show."""

from dataclasses import asdict, replace
from itertools import pairwise
import json

import numpy as np
import pytest
import torch

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    GaussianMixture,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
    find_activation,
    load_field,
)
from sgvf_drake.fields.vectors import cosine
from sgvf_drake.learning import SelfCheck, TrainingConfig, train, training
from sgvf_drake.learning.optimization import Optimization
from sgvf_drake.learning.self_check import Fault, PieceCheck
from sgvf_drake.paths import make_shape
from sgvf_drake.paths.finding import find_paths
from tests.fields import RECIPES

EACH = pytest.mark.parametrize("recipe", RECIPES)
STAGES = {"robust": ["score", "tangent"], "exact": ["tangent"], "paper": ["score", "tangent"]}
TERMS = ("unit", "orthogonality", "direction", "hint")
PASSED = SelfCheck((PieceCheck(1.0, True, 12, 12, ()),))
FAILED = SelfCheck((PieceCheck(1.0, True, 12, 11, (Fault("stall", (0.0, 0.0)),)),))


@pytest.fixture
def unchecked(monkeypatch):
    """Skips the self-check, which a few iterations would not pass anyway."""
    monkeypatch.setattr(training, "check_field", lambda field, support: PASSED)


@pytest.fixture
def two_threads():
    """Two threads of torch, in place of those that it has."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def test_the_learning_rate_warms_up_and_falls_along_half_a_cosine_to_zero():
    cosine_ = Optimization(iterations=1000, learning_rate=1.0, warmup=50, cosine=True)
    for step, expected in ((0, 1 / 50), (24, 1 / 2), (50, 1), (525, 1 / 2), (1000, 0)):
        assert cosine_.factor(step) == pytest.approx(expected, abs=1e-12)
    assert Optimization(iterations=10, learning_rate=1.0).factor(7) == 1


def short(iterations=12, **overrides):
    """A training that exercises everything and learns little."""
    counts = {"score_iterations": iterations, "tangent_iterations": iterations}
    return TrainingConfig(**{**counts, "max_restarts": 0, **overrides})


def weights(field):
    networks = [field.tangent_network]
    if isinstance(field.score_model, ScoreNetwork):
        networks.append(field.score_model.network)
    arrays = [a for n in networks for a in (*n.weights, *n.biases)]
    arrays += [n.features.frequencies for n in networks if n.features is not None]
    return np.concatenate([array.ravel() for array in arrays])


def bits(network):
    return b"".join(array.tobytes() for array in (*network.weights, *network.biases))


def ring_in_space():
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    return np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])


# Each recipe, trained anew, and compared with the stored field of the same options.


def beside_the_path(path, n=2000):
    """Points .03 to .3 from the true path, on either side."""
    rng = np.random.default_rng(0)
    piece = rng.integers(2, size=n)
    radius = np.array([2.0, 4.0])[piece] + rng.uniform(0.03, 0.3, n) * rng.choice([-1, 1], n)
    angle = rng.uniform(0, 2 * np.pi, n)
    x = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    distance = path.project(x).distance
    assert distance.min() > 0.029
    assert distance.max() < 0.301
    return x


def score_cosines(field, path):
    """The cosines between the learned score and that of the mixture, beside the path."""
    x = beside_the_path(path)
    return cosine(field.score(x), field.mixture.score(x))


@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_a_recipe_trained_anew_behaves_as_the_stored_field(request, recipe, concentric):
    """The targets of the design: both circles at full speed, counter-clockwise."""
    result = train(concentric[0], TrainingConfig(recipe=recipe))
    stored = request.getfixturevalue(f"{recipe}_field")
    assert result.self_check.passed, result.self_check.message
    assert len(result.self_check.pieces) == 2
    assert result.restarts == 0
    settings = json.loads(json.dumps(asdict(result.settings)))
    assert settings == stored.provenance["training"]
    for field in (result.field, stored):
        speed = np.linalg.norm(field(field.cloud.points), axis=1)
        np.testing.assert_allclose(speed, 1, atol=0.02)
        for piece in concentric[1].pieces:
            x = piece.sample(300)
            tangent = np.column_stack([-x[:, 1], x[:, 0]]) / np.linalg.norm(x, axis=1)[:, None]
            assert (field(x) * tangent).sum(axis=1).min() > 0.9
        if recipe == "robust":
            cosines = score_cosines(field, concentric[1])
            assert cosines.mean() >= 0.97
            assert np.percentile(cosines, 5) >= 0.93
        else:
            assert isinstance(field.score_model, GaussianMixture)
            np.testing.assert_allclose(score_cosines(field, concentric[1]), 1, atol=1e-9)
    # The losses fall; the hint is met, and hence one direction on every circle.
    history = result.history.groupby("stage")
    ratios = {"score": 0.1, "tangent": 0.2}
    for stage in STAGES[recipe]:
        total = history.get_group(stage)["total"]
        assert total.tail(10).mean() < ratios[stage] * total.iloc[0]
    assert history.get_group("tangent")["hint"].tail(10).mean() < 0.03


@pytest.mark.full
def test_the_papers_recipe_trained_anew_learns_the_score_of_the_stored_field(
    concentric, paper_field
):
    """A score worse than the robust one, .88 with seed 0; whether its field can be followed is
    left to chance, which is one of the findings.
    """
    cloud, path = concentric
    # The score is learned first, and the same whatever follows.
    field = train(cloud, TrainingConfig(recipe="paper", tangent_iterations=1)).field
    for each in (field, paper_field):
        assert 0.8 < score_cosines(each, path).mean() < 0.97
    x = beside_the_path(path)
    assert cosine(field.score(x), paper_field.score(x)).mean() > 0.8


@pytest.mark.full
def test_a_circle_in_space_is_followed_by_the_exact_recipe():
    config = TrainingConfig(recipe="exact", max_restarts=0)
    result = train(PointCloud(ring_in_space()), config)
    assert result.self_check.passed, result.self_check.message


# Short runs.


@pytest.mark.usefixtures("unchecked", "two_threads")
@EACH
def test_the_seed_decides_to_the_last_bit_and_the_history_tells_of_it(concentric, recipe):
    cloud, _ = concentric
    told = []
    config = short(22, recipe=recipe, seed=3)
    state = torch.get_rng_state()
    result = train(cloud, config, lambda *call: told.append(call))
    assert torch.get_num_threads() == 2
    assert torch.equal(torch.get_rng_state(), state)
    first = weights(result.field)
    torch.rand(17)  # what others do with torch's generator has no say
    np.testing.assert_array_equal(weights(train(cloud, config).field), first)
    other = weights(train(cloud, short(22, recipe=recipe, seed=4)).field)
    assert (other != first).mean() > 0.9
    # History and progress.
    history, stages = result.history, STAGES[recipe]
    assert history["stage"].unique().tolist() == stages
    terms = {"score": ["score"], "tangent": list(TERMS[: 3 if recipe == "paper" else 4])}
    for stage in stages:
        rows = history[history["stage"] == stage]
        assert rows["iteration"].tolist() == [0, 10, 20, 21]
        total = rows[terms[stage]].sum(axis=1, skipna=False)
        np.testing.assert_allclose(rows["total"], total, rtol=1e-5)
    assert [call for call in told if call[1] == call[2]] == [(s, 22, 22) for s in stages]
    assert result.cpu_s > 0
    assert result.wall_s > 0


@pytest.mark.usefixtures("two_threads")
def test_torchs_global_state_is_restored_after_an_error(concentric):
    def fail(*_):
        raise KeyboardInterrupt

    state = torch.get_rng_state()
    with pytest.raises(KeyboardInterrupt):
        train(concentric[0], short(), progress=fail)
    assert torch.get_num_threads() == 2
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.usefixtures("unchecked")
def test_another_unit_gives_the_same_field(concentric):
    cloud, _ = concentric
    x = np.random.default_rng(1).uniform(-5, 5, (50, 2))
    for recipe in ("robust", "exact"):
        field = train(cloud, short(recipe=recipe)).field
        for power in (-10, 10):
            # A power of two changes no digit, so nothing at all may differ.
            factor = 2.0**power
            other = train(PointCloud(factor * cloud.points), short(recipe=recipe)).field
            np.testing.assert_array_equal(other(factor * x), field(x))
            assert other.sigma == field.sigma
    # Normalised points then differ in the last bits of float64, seldom in those of float32,
    # of which a few steps of Adam amplify one by far less than a thousand.
    field = train(cloud, short()).field
    for factor in (1e-3, 1e3):
        offset = factor * np.array([30.0, -70.0])
        other = train(PointCloud(factor * cloud.points + offset), short()).field
        np.testing.assert_allclose(other(factor * x + offset), field(x), atol=1e-4)


@pytest.mark.usefixtures("unchecked")
def test_the_options_reach_the_field_and_its_file(concentric, tmp_path):
    cloud, _ = concentric

    def shapes(network):
        return [weight.shape for weight in network.weights]

    field = train(cloud, short(recipe="paper")).field
    assert field.composition == PaperComposition(0.2)
    assert (field.sigma, field.score_model.scale) == (0.1, 1.0)
    assert field.tangent_network.features is field.score_model.network.features is None
    assert shapes(field.score_model.network) == [(64, 3), *[(64, 64)] * 3, (2, 64)]
    assert shapes(field.tangent_network) == [(128, 2), (2, 128)]
    assert field.support is None
    # The robust recipe learns q, and turns over half a noise level.
    config = short(seed=np.int64(2), sigma_min=np.float32(0.25), score_hidden=(16,))
    result = train(cloud, config)
    field = result.field
    assert field.score_model.scale == field.sigma == field.composition.sigma == 0.25
    assert field.composition.gain == pytest.approx(0.5)
    assert field.approach_length == pytest.approx(0.125 * field.cloud.unit_length)
    assert shapes(field.score_model.network) == [(16, 64), (2, 16)]
    assert field.provenance["training"] == asdict(result.settings)
    ablated = {"exact_target": False, "num_frequencies": 0, "projection": False}
    bare = train(cloud, short(**ablated)).field
    assert bare.score_model.network.features is bare.tangent_network.features is None
    assert shapes(bare.score_model.network)[0] == (64, 3)
    assert shapes(bare.tangent_network)[0] == (64, 2)
    expected = RobustComposition(bare.composition.gain, bare.sigma, projects=False)
    assert bare.composition == expected
    for each in (field, bare):
        each.save(tmp_path / "field", overwrite=True)
        loaded = load_field(tmp_path / "field")
        np.testing.assert_array_equal(loaded(cloud.points), each(cloud.points))
        assert loaded.provenance == json.loads(json.dumps(each.provenance))
    exact = train(cloud, short(recipe="exact", num_frequencies=5, projection=False)).field
    assert exact.tangent_network.features.frequencies.shape == (5, 2)
    assert not exact.composition.projects


@pytest.mark.usefixtures("unchecked")
def test_the_noisy_and_the_exact_target_make_two_scores(concentric):
    for recipe in ("robust", "paper"):
        one, other, default = (
            weights(train(concentric[0], short(recipe=recipe, exact_target=exact)).field)
            for exact in (recipe == "robust", recipe != "robust", None)
        )
        np.testing.assert_array_equal(default, one)
        assert (default != other).mean() > 0.5


@pytest.mark.usefixtures("unchecked")
def test_a_loss_of_weight_zero_leaves_the_history_and_a_weight_scales_its_term(concentric):
    cases = [("paper", term) for term in TERMS[:3]] + [("robust", term) for term in TERMS]
    for recipe, term in cases:
        config = short(2, recipe=recipe, score_iterations=1, **{f"{term}_weight": 0.0})
        result = train(concentric[0], config)
        tangent = result.history[result.history["stage"] == "tangent"].dropna(axis=1)
        on = [other for other, weight in result.settings.weights.items() if weight > 0]
        assert term not in on
        assert set(tangent.columns) == {"stage", "iteration", "total", *on}
        np.testing.assert_allclose(tangent["total"], tangent[on].sum(axis=1), rtol=1e-5)
    one, eight = (
        train(concentric[0], short(1, recipe="exact", hint_weight=weight)).history.iloc[0]
        for weight in (1.0, 8.0)
    )
    assert eight["hint"] == 8 * one["hint"]
    assert eight["total"] - one["total"] == pytest.approx(7 * one["hint"], rel=1e-5)


def checks(monkeypatch, *results):
    """Replaces the self-check by given results; returns the fields that it saw."""
    seen, rest = [], list(results)

    def check(field, path):
        assert path.dim == field.dim
        seen.append(field)
        return rest.pop(0)

    monkeypatch.setattr(training, "check_field", check)
    return seen


def test_a_field_that_fails_is_trained_again_with_another_seed(concentric, monkeypatch):
    seen = checks(monkeypatch, FAILED, PASSED)
    result = train(concentric[0], short(max_restarts=2))
    assert result.restarts == 1
    assert result.self_check.passed
    assert result.field is seen[1]
    # Each restart starts from other numbers, and adds half of the first widths.
    networks = [field.score_model.network for field in seen]
    for network, width in zip(networks, (64, 96), strict=True):
        sizes = [w.shape for w in network.weights]
        assert sizes == list(pairwise([2, width, width, width, width, 64]))[::-1]
    first, second = (network.features.frequencies for network in networks)
    assert (first != second).mean() > 0.9
    assert result.settings.score_hidden == (64, 64, 64, 64)
    # The history is that of the last attempt, which had half as many iterations more.
    scores = result.history[result.history["stage"] == "score"]
    assert scores["iteration"].max() == 17
    checks(monkeypatch, FAILED, PASSED)
    again = train(concentric[0], short(max_restarts=2))
    np.testing.assert_array_equal(weights(again.field), weights(result.field))
    # One that always fails is flagged and returned.
    for max_restarts in (0, 2):
        seen = checks(monkeypatch, *[FAILED] * (max_restarts + 1))
        result = train(concentric[0], short(max_restarts=max_restarts))
        assert result.restarts == max_restarts
        assert not result.self_check.passed
        assert len(seen) == max_restarts + 1
        assert result.field is seen[-1]


@pytest.mark.usefixtures("unchecked")
@EACH
def test_a_circle_in_space(recipe):
    field = train(PointCloud(ring_in_space() + np.arange(3)), short(recipe=recipe)).field
    m, J = field.value_and_jacobian(field.cloud.points)
    assert (field.dim, m.shape, J.shape) == (3, (100, 3), (100, 3, 3))
    assert np.isfinite(m).all()
    assert np.isfinite(J).all()
    assert field.hessian(field.cloud.points[0]).shape == (3, 3, 3)


@EACH
def test_two_waypoints_are_an_open_line(recipe):
    cloud = PointCloud([[0.0, 0.0], [10.0, 1.0]])
    result = train(cloud, short(30, recipe=recipe))
    assert np.isfinite(result.field(cloud.points)).all()
    (piece,) = result.self_check.pieces
    assert piece.length == pytest.approx(np.hypot(10, 1))
    assert not piece.closed
    ends = np.empty((0, 2)) if recipe == "paper" else [[10, 1]]
    np.testing.assert_allclose(result.field.ends, ends, atol=1e-9)
    # With the score given, thirty iterations are enough for a straight line.
    assert result.self_check.passed == (recipe == "exact"), result.self_check.message


@pytest.mark.usefixtures("unchecked")
def test_ends_and_direction_are_where_the_path_leads_or_what_the_user_says(
    concentric, open_cloud
):
    right, left = (3.0, 0.0), (-2.427, -1.763)
    for choice, end in (
        ({}, right),
        ({"direction": "reverse"}, left),
        ({"start": (3.0, 1.0)}, left),
        ({"start": (-3.0, -1.0)}, right),
        ({"start": (3.0, 1.0), "direction": "reverse"}, right),
    ):
        field = train(open_cloud, short(1, recipe="exact", **choice)).field
        np.testing.assert_allclose(field.ends, [end], atol=2e-3)
    # A loop can be declared open and an arc closed.
    field = train(concentric[0], short(1, recipe="exact", open=True)).field
    np.testing.assert_allclose(np.linalg.norm(field.ends, axis=1), [4, 2], atol=0.01)
    assert train(open_cloud, short(1, recipe="exact", open=False)).field.end_points is None
    for choice, match in (
        ({"start": (0.0, 0.0, 0.0)}, "start has 3 coordinates"),
        ({"direction": ("cw",)}, "direction has 1 entries"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            train(concentric[0], short(**choice))


def test_a_reversed_field_travels_the_other_way():
    cloud, path = make_shape("circle", 100)
    x = path.pieces[0].sample(100)
    tangent = np.column_stack([-x[:, 1], x[:, 0]]) / 3
    for direction, sign in (("ccw", 1), ("cw", -1)):
        result = train(cloud, short(150, recipe="exact", direction=direction))
        assert (sign * (result.field(x) * tangent).sum(axis=1)).min() > 0.8
        assert result.self_check.passed, result.self_check.message


@pytest.mark.usefixtures("unchecked")
def test_what_is_learned_from_is_kept_with_the_field(concentric):
    cloud, _ = concentric
    result = train(cloud, short(1, recipe="exact"))
    support = result.field.support
    np.testing.assert_allclose(support, cloud.points, atol=1e-12)
    np.testing.assert_array_equal(support, cloud.denormalize(result.support.points))
    assert result.field.end_points is None
    # Noisy waypoints are replaced; the paper's recipe takes them as they are.
    noisy, path = make_shape("circle", 100, noise=0.05)
    support = train(noisy, short(1)).field.support
    assert len(support) > 100
    assert path.project(support).distance.max() < 0.2
    assert train(noisy, short(1, recipe="paper")).field.support is None
    # Coincident ones are no crash.
    doubled = PointCloud(np.repeat(make_shape("circle", 30)[0].points, 5, axis=0))
    assert np.isfinite(train(doubled, short()).field(doubled.points)).all()


@pytest.mark.usefixtures("unchecked")
def test_a_network_is_trained_on_as_it_is(concentric):
    """Its lines are the waypoints, and its directions are kept."""
    network = find_paths(concentric[0], direction=("cw", "ccw"))
    field = train(network, short(200, recipe="exact")).field
    assert field.network is network
    for radius, sense in ((4.0, -1), (2.0, 1)):
        x = radius * np.column_stack([np.cos(np.arange(60)), np.sin(np.arange(60))])
        ccw = np.column_stack([-x[:, 1], x[:, 0]]) / radius
        assert (sense * (field(x) * ccw).sum(axis=1)).min() > 0.9
    with pytest.raises(ConfigurationError, match="closed: a network has its own"):
        train(network, TrainingConfig(open=True))


@pytest.mark.usefixtures("unchecked")
def test_paths_that_branch_are_refused_where_no_directed_field_is_learned():
    radius = np.linspace(0, 4, 60)
    arms = [np.outer(radius, [np.cos(a), np.sin(a)]) for a in np.radians([90, 210, 330])]
    cloud = PointCloud(np.concatenate(arms))
    with pytest.raises(ConfigurationError, match=r"network, .* with 1 junction, 3 ends"):
        train(cloud, short(1, recipe="paper"))
    for recipe in RECIPES:
        result = train(cloud, short(1, recipe=recipe, anyway=True))
        assert result.network.count("junction") == 1
        assert result.guiding_field is result.field


# With a score that was trained before.


def turned(network):
    """The network with its outputs turned by a right angle."""
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    weights = (*network.weights[:-1], turn @ network.weights[-1])
    biases = (*network.biases[:-1], turn @ network.biases[-1])
    return replace(network, weights=weights, biases=biases)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "paper"])
def test_a_given_score_is_kept_and_the_tangent_is_that_of_both(concentric, recipe):
    for exact_target in (True, False):
        config = short(recipe=recipe, seed=5, exact_target=exact_target)
        both = train(concentric[0], config).field
        score, told = both.score_model, []
        before = bits(score.network)
        tell = lambda stage, done, total, told=told: told.append(stage)  # noqa: E731
        result = train(concentric[0], config, tell, score=score)
        assert set(told) == {"tangent"} == set(result.history["stage"])
        assert "score" not in result.history.columns
        assert result.field.score_model is score
        assert bits(score.network) == before
        assert bits(result.field.tangent_network) == bits(both.tangent_network)
        assert result.field.provenance["score"] == "given"
        assert "score" not in both.provenance
    # It is learned on the given one.
    other = train(concentric[0], config, score=replace(score, network=turned(score.network)))
    tangents = [
        np.concatenate([w.ravel() for w in field.tangent_network.weights])
        for field in (both, other.field)
    ]
    assert (tangents[0] != tangents[1]).mean() > 0.9


def test_every_attempt_has_the_given_score(concentric, robust_field, monkeypatch):
    score = robust_field.score_model
    seen = checks(monkeypatch, FAILED, PASSED)
    result = train(concentric[0], short(max_restarts=2), score=score)
    assert result.restarts == 1
    assert [field.score_model for field in seen] == [score, score]
    assert bits(seen[0].tangent_network) != bits(seen[1].tangent_network)


def test_a_score_that_does_not_fit_is_refused(concentric, make_field):
    score = make_field("robust").score_model
    network = replace(score.network, activation=find_activation("Tanh"))
    for recipe, other, match in (
        ("exact", score, "^score is not for the recipe exact"),
        (
            "robust",
            make_field("exact").score_model,
            "^score must be a ScoreNetwork, not GaussianMixture",
        ),
        (
            "robust",
            make_field("robust", dim=3).score_model,
            "^score has 4 inputs and 3 outputs.* 3 and 2",
        ),
        ("robust", replace(score, network=network), "^score has the activation Tanh"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            train(concentric[0], short(recipe=recipe), score=other)
