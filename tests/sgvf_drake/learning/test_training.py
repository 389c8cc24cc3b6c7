from dataclasses import asdict
import json

import numpy as np
import pytest
import torch

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    GaussianMixture,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
    load_field,
)
from sgvf_drake.learning import SelfCheck, TrainingConfig, train, training
from sgvf_drake.learning.self_check import Fault, PieceCheck
from sgvf_drake.paths import PointCloud, make_shape

PASSED = SelfCheck((PieceCheck(1.0, True, 12, 12, ()),))
FAILED = SelfCheck((PieceCheck(1.0, True, 12, 11, (Fault("stall", (0.0, 0.0)),)),))


@pytest.fixture
def unchecked(monkeypatch):
    """Skips the self-check, which a few iterations would not pass anyway."""
    monkeypatch.setattr(training, "check_field", lambda field, support: PASSED)


def short(**overrides):
    """A training that exercises everything and learns little."""
    return TrainingConfig(
        **{"score_iterations": 30, "tangent_iterations": 30, "max_restarts": 0, **overrides}
    )


def weights(field):
    networks = [field.tangent_network]
    if isinstance(field.score_model, ScoreNetwork):
        networks.append(field.score_model.network)
    arrays = [a for n in networks for a in (*n.weights, *n.biases)]
    arrays += [n.features.frequencies for n in networks if n.features is not None]
    return np.concatenate([array.ravel() for array in arrays])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_the_seed_decides_to_the_last_bit(concentric, recipe):
    cloud, _ = concentric
    config = short(recipe=recipe, seed=3)
    first = weights(train(cloud, config).field)
    torch.rand(17)  # what others do with torch's generator has no say
    np.testing.assert_array_equal(weights(train(cloud, config).field), first)
    other = weights(train(cloud, short(recipe=recipe, seed=4)).field)
    assert (other != first).mean() > 0.9


@pytest.mark.usefixtures("unchecked")
def test_torchs_global_state_is_left_alone(concentric):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        state = torch.get_rng_state()
        train(concentric[0], short())
        assert torch.get_num_threads() == 2
        assert torch.equal(torch.get_rng_state(), state)
    finally:
        torch.set_num_threads(threads)


def test_torchs_global_state_is_restored_after_an_error(concentric):
    threads = torch.get_num_threads()

    def fail(*_):
        raise KeyboardInterrupt

    try:
        torch.set_num_threads(2)
        state = torch.get_rng_state()
        with pytest.raises(KeyboardInterrupt):
            train(concentric[0], short(), progress=fail)
        assert torch.get_num_threads() == 2
        assert torch.equal(torch.get_rng_state(), state)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("recipe", "stages"),
    [("robust", ["score", "tangent"]), ("exact", ["tangent"]), ("paper", ["score", "tangent"])],
)
def test_history_and_progress(concentric, recipe, stages):
    told = []
    result = train(concentric[0], short(recipe=recipe), lambda *call: told.append(call))
    history = result.history
    assert history["stage"].unique().tolist() == stages
    tangent_terms = ["unit", "orthogonality", "direction"]
    tangent_terms += ["hint"] if recipe != "paper" else []
    for stage, terms in {"score": ["score"], "tangent": tangent_terms}.items():
        rows = history[history["stage"] == stage]
        if stage not in stages:
            assert rows.empty
            continue
        assert rows["iteration"].tolist() == [0, 10, 20, 29]
        total = rows[terms].sum(axis=1, skipna=False)
        np.testing.assert_allclose(rows["total"], total, rtol=1e-5)
    assert [call for call in told if call[1] == call[2]] == [(s, 30, 30) for s in stages]
    assert result.cpu_s > 0
    assert result.wall_s > 0


def test_the_default_training_passes_its_self_check(robust_result, exact_result):
    for result in (robust_result, exact_result):
        assert result.self_check.passed, result.self_check.message
        assert len(result.self_check.pieces) == 2


def test_the_losses_fall(robust_result):
    history = robust_result.history
    score = history.loc[history["stage"] == "score", "total"]
    tangent = history.loc[history["stage"] == "tangent", "total"]
    assert score.tail(10).mean() < 0.1 * score.iloc[0]
    # The hint is met, and hence one direction on every circle.
    hint = history.loc[history["stage"] == "tangent", "hint"]
    assert hint.tail(10).mean() < 0.03
    assert tangent.tail(10).mean() < 0.2 * tangent.iloc[0]


def beside_the_path(path, seed=0, n=2000):
    """Points .03 to .3 from the true path, on either side."""
    rng = np.random.default_rng(seed)
    piece = rng.integers(2, size=n)
    radius = np.array([2.0, 4.0])[piece] + rng.uniform(0.03, 0.3, n) * rng.choice([-1, 1], n)
    angle = rng.uniform(0, 2 * np.pi, n)
    x = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    distance = path.project(x).distance
    assert distance.min() > 0.029
    assert distance.max() < 0.301
    return x


def test_the_learned_score_is_that_of_the_mixture_near_the_path(robust_result, concentric):
    """The target of the design for the mean, .97, and its range for the 5th percentile."""
    field = robust_result.field
    x = beside_the_path(concentric[1])
    learned, exact = field.score(x), field.mixture.score(x)
    cosine = (learned * exact).sum(axis=1) / (
        np.linalg.norm(learned, axis=1) * np.linalg.norm(exact, axis=1)
    )
    assert cosine.mean() >= 0.97
    assert np.percentile(cosine, 5) >= 0.93


@pytest.mark.parametrize("result", ["robust_result", "exact_result"])
def test_the_speed_on_the_waypoints_is_one(result, request):
    field = request.getfixturevalue(result).field
    speed = np.linalg.norm(field(field.cloud.points), axis=1)
    np.testing.assert_allclose(speed, 1, atol=0.02)


@pytest.mark.parametrize("result", ["robust_result", "exact_result"])
def test_both_circles_are_travelled_counter_clockwise(result, request, concentric):
    field = request.getfixturevalue(result).field
    for piece in concentric[1].pieces:
        x = piece.sample(300)
        tangent = np.column_stack([-x[:, 1], x[:, 0]]) / np.linalg.norm(x, axis=1)[:, None]
        along = (field(x) * tangent).sum(axis=1)
        assert along.min() > 0.9


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "exact"])
@pytest.mark.parametrize("power", [-10, 10])
def test_another_unit_gives_the_same_field(concentric, recipe, power):
    """A power of two changes no digit, so nothing at all may differ."""
    cloud, _ = concentric
    factor = 2.0**power
    scaled = PointCloud(factor * cloud.points)
    field = train(cloud, short(recipe=recipe)).field
    other = train(scaled, short(recipe=recipe)).field
    x = np.random.default_rng(1).uniform(-5, 5, (50, 2))
    np.testing.assert_array_equal(other(factor * x), field(x))
    assert other.sigma == field.sigma


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_millimetres_and_kilometres_away_from_the_origin(concentric, factor):
    """Normalised points differ in the last bits of float64, seldom in those of float32.

    Thirty steps of Adam amplify a bit of float32 by far less than a thousand.
    """
    cloud, _ = concentric
    offset = factor * np.array([30.0, -70.0])
    moved = PointCloud(factor * cloud.points + offset)
    field, other = train(cloud, short()).field, train(moved, short()).field
    x = np.random.default_rng(1).uniform(-5, 5, (50, 2))
    np.testing.assert_allclose(other(factor * x + offset), field(x), atol=1e-4)


def test_the_exact_recipe_has_no_score_network(exact_result):
    field = exact_result.field
    assert isinstance(field.score_model, GaussianMixture)
    assert isinstance(field.composition, RobustComposition)
    assert field.recipe == "exact"
    x = np.random.default_rng(2).uniform(-5, 5, (100, 2))
    mixture = GaussianMixture(field.cloud.points, field.sigma * field.cloud.unit_length)
    np.testing.assert_allclose(field.score(x), mixture.score(x), rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("unchecked")
def test_the_paper_recipe_has_the_papers_networks(concentric):
    field = train(concentric[0], short(recipe="paper")).field
    assert field.composition == PaperComposition(0.2)
    assert (field.sigma, field.score_model.scale) == (0.1, 1.0)
    assert field.tangent_network.features is field.score_model.network.features is None
    shapes = [w.shape for w in field.score_model.network.weights]
    assert shapes == [(64, 3), (64, 64), (64, 64), (64, 64), (2, 64)]
    assert [w.shape for w in field.tangent_network.weights] == [(128, 2), (2, 128)]
    assert np.isfinite(field(field.cloud.points)).all()


@pytest.mark.usefixtures("unchecked")
def test_the_robust_recipe_learns_q_and_turns_over_half_a_noise_level(concentric):
    result = train(concentric[0], short(sigma_min=0.2, score_hidden=(16,)))
    field = result.field
    assert field.score_model.scale == field.sigma == field.composition.sigma == 0.2
    assert field.composition.gain == pytest.approx(0.4)
    assert field.approach_length == pytest.approx(0.1 * field.cloud.unit_length)
    assert [w.shape for w in field.score_model.network.weights] == [(16, 64), (2, 16)]
    assert field.provenance["training"] == asdict(result.settings)


@pytest.mark.usefixtures("unchecked")
def test_a_trained_field_is_saved_whatever_the_type_of_its_seed(concentric, tmp_path):
    field = train(concentric[0], short(seed=np.int64(2), sigma_min=np.float32(0.25))).field
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    np.testing.assert_array_equal(loaded(field.cloud.points), field(field.cloud.points))
    assert loaded.provenance == json.loads(json.dumps(field.provenance))


def checks(monkeypatch, *results):
    """Replaces the self-check by given results; returns the fields that it saw."""
    seen, rest = [], list(results)

    def check(field, support):
        assert support.sigma == field.sigma
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
    first, second = (field.score_model.network for field in seen)
    assert [w.shape for w in first.weights] == [(64, 64), *[(64, 64)] * 3, (2, 64)]
    assert [w.shape for w in second.weights] == [(96, 64), *[(96, 96)] * 3, (2, 96)]
    assert (first.features.frequencies != second.features.frequencies).mean() > 0.9
    assert result.settings.score_hidden == (64, 64, 64, 64)
    history = result.history
    # The history is that of the last attempt, which had half as many iterations more.
    assert history.loc[history["stage"] == "score", "iteration"].max() == 44
    checks(monkeypatch, FAILED, PASSED)
    again = train(concentric[0], short(max_restarts=2))
    np.testing.assert_array_equal(weights(again.field), weights(result.field))


@pytest.mark.parametrize("max_restarts", [0, 2])
def test_a_field_that_always_fails_is_flagged_and_returned(
    concentric, monkeypatch, max_restarts
):
    seen = checks(monkeypatch, *[FAILED] * (max_restarts + 1))
    result = train(concentric[0], short(max_restarts=max_restarts))
    assert result.restarts == max_restarts
    assert not result.self_check.passed
    assert len(seen) == max_restarts + 1
    assert result.field is seen[-1]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_a_circle_in_space(recipe):
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    points = np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])
    field = train(PointCloud(points + np.arange(3)), short(recipe=recipe)).field
    m, J = field.value_and_jacobian(field.cloud.points)
    assert (field.dim, m.shape, J.shape) == (3, (100, 3), (100, 3, 3))
    assert np.isfinite(m).all()
    assert np.isfinite(J).all()
    assert field.hessian(field.cloud.points[0]).shape == (3, 3, 3)


def test_a_circle_in_space_is_followed_by_the_exact_recipe():
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    points = np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])
    result = train(PointCloud(points), TrainingConfig(recipe="exact", max_restarts=0))
    assert result.self_check.passed, result.self_check.message


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_two_waypoints_are_an_open_line(recipe):
    cloud = PointCloud([[0.0, 0.0], [10.0, 1.0]])
    result = train(cloud, short(recipe=recipe))
    assert np.isfinite(result.field(cloud.points)).all()
    (piece,) = result.self_check.pieces
    assert piece.length == pytest.approx(np.hypot(10, 1))
    assert not piece.closed
    if recipe == "paper":
        assert result.field.ends.shape == (0, 2)
    else:
        np.testing.assert_allclose(result.field.ends, [[10, 1]], atol=1e-9)
    if recipe == "exact":
        # With the score given, thirty iterations are enough for a straight line.
        assert result.self_check.passed, result.self_check.message
    else:
        assert not result.self_check.passed


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("choice", "end"),
    [
        ({}, (3.0, 0.0)),
        ({"direction": "reverse"}, (-2.427, -1.763)),
        ({"start": (3.0, 1.0)}, (-2.427, -1.763)),
        ({"start": (-3.0, -1.0)}, (3.0, 0.0)),
        ({"start": (3.0, 1.0), "direction": "reverse"}, (3.0, 0.0)),
    ],
)
def test_the_end_of_an_open_path_is_where_it_leads(open_cloud, choice, end):
    field = train(open_cloud, short(recipe="exact", **choice)).field
    np.testing.assert_allclose(field.ends, [end], atol=2e-3)


@pytest.mark.usefixtures("unchecked")
def test_what_is_learned_from_is_kept_with_the_field(concentric):
    cloud, _ = concentric
    result = train(cloud, short(recipe="exact"))
    np.testing.assert_allclose(result.field.support, cloud.points, atol=1e-12)
    np.testing.assert_array_equal(
        result.field.support, cloud.denormalize(result.support.points)
    )
    assert result.field.end_points is None
    # Noisy waypoints are replaced; the paper's recipe takes them as they are.
    noisy, path = make_shape("circle", 40, noise=0.05)
    support = train(noisy, short()).field.support
    assert len(support) > 100
    assert path.project(support).distance.max() < 0.2
    assert train(noisy, short(recipe="paper")).field.support is None


@pytest.mark.usefixtures("unchecked")
def test_a_loop_can_be_declared_open_and_an_arc_closed(concentric, open_cloud):
    field = train(concentric[0], short(recipe="exact", open=True)).field
    assert field.ends.shape == (2, 2)
    np.testing.assert_allclose(np.linalg.norm(field.ends, axis=1), [4, 2], atol=0.01)
    assert train(open_cloud, short(recipe="exact", open=False)).field.end_points is None


@pytest.mark.usefixtures("unchecked")
def test_choices_that_do_not_fit_the_path_are_refused(concentric):
    with pytest.raises(ConfigurationError, match="start has 3 coordinates"):
        train(concentric[0], short(start=(0.0, 0.0, 0.0)))
    with pytest.raises(ConfigurationError, match="direction has 1 entries"):
        train(concentric[0], short(direction=("cw",)))


def test_a_reversed_field_travels_the_other_way():
    cloud, path = make_shape("circle", 100)
    x = path.pieces[0].sample(100)
    tangent = np.column_stack([-x[:, 1], x[:, 0]]) / 3
    for direction, sign in (("ccw", 1), ("cw", -1), ("reverse", -1)):
        config = short(recipe="exact", direction=direction, tangent_iterations=150)
        result = train(cloud, config)
        assert (sign * (result.field(x) * tangent).sum(axis=1)).min() > 0.8
        assert result.self_check.passed, result.self_check.message


def test_coincident_waypoints_are_no_crash():
    cloud, _ = make_shape("circle", num_points=30)
    doubled = PointCloud(np.repeat(cloud.points, 5, axis=0))
    result = train(doubled, short())
    assert np.isfinite(result.field(doubled.points)).all()
    assert len(result.self_check.pieces) == 1


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("recipe", "name", "term"),
    [
        *(("paper", f"{term}_weight", term) for term in ("unit", "orthogonality", "direction")),
        *(("robust", f"{term}_weight", term) for term in ("unit", "direction", "hint")),
    ],
)
def test_a_loss_of_weight_zero_leaves_the_history(concentric, recipe, name, term):
    config = short(recipe=recipe, score_iterations=1, tangent_iterations=2, **{name: 0.0})
    result = train(concentric[0], config)
    tangent = result.history[result.history["stage"] == "tangent"].dropna(axis=1)
    weights = result.settings.weights
    on = [other for other, weight in weights.items() if weight > 0]
    assert term not in on
    assert set(tangent.columns) == {"stage", "iteration", "total", *on}
    np.testing.assert_allclose(tangent["total"], tangent[on].sum(axis=1), rtol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_a_weight_scales_its_term_of_the_total(concentric):
    first = [
        train(concentric[0], short(recipe="exact", tangent_iterations=1, hint_weight=weight))
        .history.iloc[0]
        .drop("stage")
        for weight in (1.0, 8.0)
    ]
    assert first[1]["hint"] == 8 * first[0]["hint"]
    assert first[1]["total"] - first[0]["total"] == pytest.approx(
        7 * first[0]["hint"], rel=1e-5
    )


@pytest.mark.usefixtures("unchecked")
def test_the_options_of_the_ablations_reach_the_field(concentric, tmp_path):
    cloud, _ = concentric
    config = short(exact_target=False, num_frequencies=0, projection=False)
    field = train(cloud, config).field
    assert field.score_model.network.features is field.tangent_network.features is None
    assert field.score_model.network.weights[0].shape == (64, 3)
    assert field.tangent_network.weights[0].shape == (64, 2)
    assert field.composition == RobustComposition(
        field.composition.gain, field.sigma, projects=False
    )
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    np.testing.assert_array_equal(loaded(cloud.points), field(cloud.points))
    exact = train(cloud, short(recipe="exact", num_frequencies=5, projection=False)).field
    assert exact.tangent_network.features.frequencies.shape == (5, 2)
    assert not exact.composition.projects


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("recipe", ["robust", "paper"])
def test_the_noisy_and_the_exact_target_make_two_scores(concentric, recipe):
    one, other = (
        train(concentric[0], short(recipe=recipe, tangent_iterations=1, exact_target=exact))
        for exact in (True, False)
    )
    default = train(concentric[0], short(recipe=recipe, tangent_iterations=1))
    same, differs = (one, other) if recipe == "robust" else (other, one)
    np.testing.assert_array_equal(weights(default.field), weights(same.field))
    assert (weights(default.field) != weights(differs.field)).mean() > 0.5
