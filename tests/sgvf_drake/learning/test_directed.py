"""Learning directed fields: what is learned from, the network and the mixture, the check."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
import pytest
import torch

from sgvf_drake import certify, enclose_zeros, find_singularities, verify
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.follow import follow_network
from sgvf_drake.fields import DirectedField, StrandMixture, StrandNetwork, load_field
from sgvf_drake.learning import SelfCheck, TrainingConfig, train, training
from sgvf_drake.learning.directed import HeadingNetwork, strand_loss, strand_target
from sgvf_drake.learning.route_check import check_directed
from sgvf_drake.learning.strands import find_strands
from sgvf_drake.learning.support import SIGMA_DEFAULT, WIDEST_GAP
from sgvf_drake.passages import straight_on
from sgvf_drake.paths.itinerary import successors
from tests.networks import clean_cloud, clean_network, straight_network

Array = NDArray[np.float64]


@pytest.mark.parametrize("name", ["eight", "T", "Y in space"])
def test_strands_lie_evenly_on_the_edges_and_point_along_them(name: str) -> None:
    cloud, network = clean_cloud(name), clean_network(name)
    support = find_strands(cloud, network)
    mixture, unit = support.mixture, cloud.unit_length
    assert len(mixture.points) == sum(support.counts)
    on_path = network.path.project(cloud.denormalize(mixture.points))
    assert on_path.distance.max() < 1e-9 * unit
    lengths = np.array([edge.length for edge in network.edges]) / unit
    np.testing.assert_allclose(lengths / support.counts, mixture.sigma / 2, rtol=0.1)
    np.testing.assert_allclose(np.linalg.norm(mixture.directions, axis=1), 1, rtol=1e-12)
    first = slice(0, support.counts[0])
    steps = np.diff(mixture.points[first], axis=0)
    cosines = (steps * mixture.directions[first][1:]).sum(axis=1) / np.linalg.norm(
        steps, axis=1
    )
    assert cosines.min() > 0.95
    assert mixture.one_way.all() == (name == "eight")


def rails(gap: float) -> tuple[PointCloud, float, float]:
    """Two rails this far apart that a wide bow joins; returns the noise level and the gap."""
    places = np.array([[-4.0, 0.0], [4.0, 0.0], [-4.0, gap], [4.0, gap]])
    bow = np.array([[-6.0, -2.0], [-8.0, gap / 2], [-6.0, gap + 2.0]])
    network = straight_network(places, [(0, 1), (2, 3), (0, 2)], {2: bow})
    cloud = PointCloud(np.concatenate([edge.line.sample(100) for edge in network.edges]))
    support = find_strands(cloud, network)
    return cloud, support.sigma * cloud.unit_length, support.gap * cloud.unit_length


def test_strands_side_by_side_lower_the_noise_level_and_those_that_meet_do_not() -> None:
    cloud, sigma, gap = rails(0.2)
    assert gap == pytest.approx(0.2, abs=0.03)
    assert sigma == pytest.approx(gap / 4)
    cloud, sigma, gap = rails(3.0)
    assert gap == pytest.approx(WIDEST_GAP * cloud.unit_length)
    # Strands that part at 30 degrees are near each other, and no neighbours for that.
    places = np.array([[0.0, 0], [-4, 0], [4, 0], [4 * np.cos(0.52), 4 * np.sin(0.52)]])
    network = straight_network(places, [(0, 1), (0, 2), (0, 3)])
    cloud = PointCloud(np.concatenate([edge.line.sample(100) for edge in network.edges]))
    assert find_strands(cloud, network).sigma == SIGMA_DEFAULT


def test_the_noise_level_leaves_room_between_two_nodes() -> None:
    places = np.array([[0.0, 0], [0.3, 0], [-4, 0], [0, 4], [4.3, 0], [0.3, -4]])
    network = straight_network(places, [(0, 1), (0, 2), (0, 3), (1, 4), (1, 5)])
    cloud = PointCloud(np.concatenate([edge.line.sample(100) for edge in network.edges]))
    sigma = find_strands(cloud, network).sigma * cloud.unit_length
    assert sigma == pytest.approx(0.3 / 6)


@pytest.mark.parametrize("two_way", [True, False])
def test_the_torch_network_is_the_one_of_the_field(two_way: bool) -> None:
    torch.manual_seed(0)
    network = HeadingNetwork(2, (16, 16), 8, 2.0, two_way)
    strands = StrandNetwork(network.to_perceptron(), 1.0, two_way)
    x, g = torch.randn(2, 20, 2)
    output = network(x, g).detach().numpy()
    S, N = strands(x.double().numpy(), g.double().numpy())
    np.testing.assert_allclose(np.concatenate([S, N], axis=1), output, atol=1e-5)


class Oracle(torch.nn.Module):
    """The exact mixture in place of a network, by NumPy."""

    def __init__(self, mixture: StrandMixture) -> None:
        super().__init__()
        self.mixture = mixture

    def forward(self, x: torch.Tensor, g: torch.Tensor) -> torch.Tensor:
        S, N = self.mixture(x.double().numpy(), g.double().numpy())
        return torch.as_tensor(np.concatenate([self.mixture.sigma * S, N], axis=1))


@pytest.mark.parametrize("name", ["T", "eight"])
def test_the_mixture_itself_has_no_loss(name: str) -> None:
    torch.manual_seed(0)
    mixture = find_strands(clean_cloud(name), clean_network(name)).mixture
    terms = strand_loss(Oracle(mixture), mixture)()  # type: ignore[arg-type]
    assert all(term.item() < 1e-6 for term in terms.values())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("sigma", [0.1, 0.02])
def test_the_target_is_the_mixture_of_both_kinds_of_strand(
    dim: int, share: float, sigma: float
) -> None:
    rng = np.random.default_rng(0)
    points, directions = rng.uniform(-4, 4, (300, dim)), rng.normal(size=(300, dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    mixture = StrandMixture(points, directions, rng.uniform(size=300) < share, sigma)
    # In float32 as the target, which is off by its rounding of |x|^2 / sigma^2.
    x = (points[:200] + 2 * sigma * rng.normal(size=(200, dim))).astype(np.float32)
    g = directions[rng.integers(300, size=200)].astype(np.float32)
    output = strand_target(mixture)(torch.as_tensor(x), torch.as_tensor(g)).numpy()
    S, N = mixture(x.astype(float), g.astype(float))
    expected = np.concatenate([sigma * S, N], axis=1)
    np.testing.assert_allclose(output, expected, atol=1e-7 * 4 * 50 / sigma**2 + 1e-5)


@pytest.mark.parametrize("name", ["T", "X", "eight", "roundabout"])
def test_every_edge_and_every_turn_is_driven(name: str) -> None:
    result = train(clean_cloud(name), TrainingConfig(recipe="exact"))
    check = result.self_check
    assert check.passed, check.message
    following, ahead = successors(result.network), straight_on(result.network)
    turns = sum(map(len, following.values()))
    straight = sum(ahead.get(number) in after for number, after in following.items())
    around = 4 * len(result.network.edges)
    assert sum(piece.starts for piece in check.pieces) == turns + straight + around
    assert result.restarts == 0


def test_a_field_that_misses_turns_fails_its_check(tee_field: DirectedField) -> None:
    """Strands that pull one way only cannot be driven back."""
    field = tee_field
    assert isinstance(field.strands, StrandMixture)
    one_way = np.ones_like(field.strands.one_way)
    broken = replace(field, strands=replace(field.strands, one_way=one_way))
    check = check_directed(broken)
    assert not check.passed
    assert {fault.kind for fault in check.pieces[0].faults} == {"skip"}
    # Without the projection, robots stop on the way.
    assert check_directed(field).passed


def test_a_path_is_driven_from_its_very_start() -> None:
    """Backwards for its first 1.5, and then as it should be."""
    t = np.linspace(-1.5, 1.5, 400)
    cloud = PointCloud(np.column_stack([3 * t**3 - 3 * t, 3 * t**2]))
    field = train(cloud, TrainingConfig(recipe="exact", max_restarts=0)).field
    assert isinstance(field, DirectedField)
    strands, start = field.strands, field.network.edges[0].line.vertices[0]
    assert isinstance(strands, StrandMixture)
    assert check_directed(field).passed
    away = np.linalg.norm(cloud.denormalize(strands.points) - start, axis=1)
    directions = np.where(away[:, None] < 1.5, -1, 1) * strands.directions
    broken = replace(field, strands=replace(strands, directions=directions))
    fault = next(f for f in check_directed(broken).pieces[0].faults if f.kind == "skip")
    assert np.linalg.norm(fault.point - start) < 1.5


@pytest.mark.parametrize(("degrees", "kept"), [(30, False), (60, True)])
def test_who_turns_off_at_a_crossing_without_a_route_fails_the_check(
    degrees: float, kept: bool
) -> None:
    """Noise bends lines where they cross at a small angle, as robots show that follow them."""
    half = np.radians(degrees / 2)
    line = 4 * np.linspace(-1, 1, 300)[:, None]
    lines = [line * [np.cos(half), sign * np.sin(half)] for sign in (1, -1)]
    noise = 0.02 * np.random.default_rng(0).normal(size=(600, 2))
    config = TrainingConfig(recipe="exact", max_restarts=0)
    result = train(PointCloud(np.concatenate(lines) + noise), config)
    assert isinstance(result.field, DirectedField)
    driven = follow_network(result.field, 30).summary()["straight_fraction"]
    assert (driven == 1) == kept
    faults = [fault.kind for fault in result.self_check.pieces[0].faults]
    assert set(faults) == (set() if kept else {"turn"})


def test_a_field_that_leads_nowhere_is_left(eight_field: DirectedField) -> None:
    field = eight_field
    assert isinstance(field.strands, StrandMixture)
    away = replace(field.strands, points=field.strands.points + 1.5)
    check = check_directed(replace(field, strands=away))
    assert "leave" in {fault.kind for fault in check.pieces[0].faults}


def test_acute_tips_are_told_and_a_route_turns_at_them() -> None:
    places = np.array([[-1.0, 0.0], [1.0, 0.0], [-3.0, -4.0], [3.0, -4.0]])
    messages = {}
    for height in (4.0, 1.0):
        tip = {3: np.array([[0.0, height]])}
        network = straight_network(places, [(0, 1), (0, 2), (1, 3), (0, 1)], tip)
        result = train(network, TrainingConfig(recipe="exact"))
        assert result.self_check.passed, result.self_check.message
        messages[height] = result.support.messages
    assert messages[1.0] == ()
    assert "edge 4 has an acute tip" in messages[4.0][0]


def test_what_knows_fields_of_the_position_alone_refuses_others(
    tee_field: DirectedField,
) -> None:
    for examine in (verify, certify, find_singularities, enclose_zeros):
        with pytest.raises(ConfigurationError, match=r"directed field m\(x, g\) of a network"):
            examine(tee_field)


def test_options_of_other_fields_are_refused() -> None:
    network = clean_network("T")
    for name, value in (("hint_weight", 1.0), ("score_iterations", 5), ("exact_target", True)):
        config = TrainingConfig(**{name: value})
        with pytest.raises(ConfigurationError, match=f"{name} is not for paths that branch"):
            train(network, config)


def test_training_is_repeatable_and_follows_the_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So few iterations would not pass it anyway.
    monkeypatch.setattr(training, "check_directed", lambda field: SelfCheck(()))
    network = clean_network("T")
    few = {"tangent_iterations": 3, "max_restarts": 0}
    one, same, other = (
        train(network, TrainingConfig(seed=seed, **few)).field for seed in (0, 0, 1)
    )
    x, g = np.random.default_rng(0).normal(size=(2, 10, 2))
    np.testing.assert_array_equal(one(x, g), same(x, g))
    one.save(tmp_path / "field.safetensors")
    read = load_field(tmp_path / "field.safetensors")
    assert isinstance(read, DirectedField)
    np.testing.assert_array_equal(read(x, g), one(x, g))
    assert np.abs(one(x, g) - other(x, g)).max() > 0.1


@pytest.mark.full
@pytest.mark.parametrize("name", ["eight", "T", "Y in space"])
def test_the_robust_recipe_learns_what_the_mixture_is(name: str) -> None:
    result = train(clean_cloud(name), TrainingConfig())
    assert result.self_check.passed, result.self_check.message
    field, mixture = result.field, result.support.mixture
    assert isinstance(field, DirectedField)
    assert isinstance(field.strands, StrandNetwork)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(mixture.points), 500)
    x = mixture.points[chosen] + mixture.sigma * rng.normal(size=(500, field.dim))
    g = mixture.directions[chosen]
    S, N = field.strands(x, g)
    S_true, N_true = mixture(x, g)
    assert np.sqrt(((S - S_true) ** 2).sum(axis=1).mean()) * mixture.sigma < 0.15
    assert np.sqrt(((N - N_true) ** 2).sum(axis=1).mean()) < 0.1
