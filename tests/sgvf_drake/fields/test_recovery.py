"""Waypoints from a score alone: on its ridge, or a box where there is none."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from sgvf_drake import ConfigurationError, GaussianMixture, PointCloud
from sgvf_drake.fields import Perceptron, ScoreNetwork, find_activation, recover_waypoints
from sgvf_drake.fields.importing import perceptron_from_arrays
from sgvf_drake.paths import make_shape
from sgvf_drake.paths.finding import find_paths


def dense(path):
    return np.concatenate([piece.sample(4_000) for piece in path.pieces])


# A corner is rounded by about the noise level; on circles, the mean of the density lies inside
# by about sigma^2 / 2 R.
@pytest.mark.parametrize(
    ("shape", "sampling", "sigma", "largest"),
    [
        ("concentric-circles", "uniform", 0.1, 0.006),
        ("star", "uniform", 0.1, 0.1),
        ("square", "random", 0.3, 0.2),
    ],
)
def test_the_path_of_an_exact_score(shape, sampling, sigma, largest):
    cloud, path = make_shape(shape, sampling=sampling, seed=1)
    points, origin = recover_waypoints(GaussianMixture(cloud.points, sigma))
    assert origin == "score"
    assert cKDTree(dense(path)).query(points)[0].max() < largest
    # All of it but for tips and gaps between waypoints, and every piece as one.
    assert cKDTree(points).query(dense(path))[0].max() < 0.5
    pieces = find_paths(PointCloud(points)).path.pieces
    assert [piece.closed for piece in pieces] == [True] * len(path.pieces)
    assert pdist(points).min() > 0.1


def test_the_path_of_a_learned_score(robust_field, concentric):
    """It was learned on circles of the paper's unit."""
    assert robust_field.cloud.unit_length == pytest.approx(1, rel=1e-3)
    points, origin = recover_waypoints(robust_field.score_model)
    assert origin == "score"
    distances = cKDTree(dense(concentric[1])).query(points)[0]
    assert distances.mean() < 0.05
    assert distances.max() < 0.15
    pieces = find_paths(PointCloud(points)).path.pieces
    assert [piece.closed for piece in pieces] == [True, True]
    lengths = [piece.length for piece in pieces]
    assert lengths == pytest.approx([8 * np.pi, 4 * np.pi], rel=0.03)
    again, _ = recover_waypoints(robust_field.score_model)
    np.testing.assert_array_equal(again, points)


def test_the_path_of_the_fitted_ring(ring_networks):
    score = perceptron_from_arrays(ring_networks[0].state_dict(), find_activation("Tanh"))
    points, origin = recover_waypoints(ScoreNetwork(score, 1.0))
    assert origin == "score"
    # To what its last layer was fitted.
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 3, atol=1e-4)


def test_a_score_without_a_path_in_the_box_leaves_the_box(make_sequential):
    """A square stands in, whose cloud has the unit and the box of the paper's shapes."""
    cloud, _ = make_shape("circle")
    models = [GaussianMixture(cloud.points + np.array([20.0, 0.0]), 0.3)]
    for name in ("SiLU", "ReLU"):
        network = make_sequential([3, 64, 64, 2], name, seed=5)
        score = perceptron_from_arrays(network.state_dict(), find_activation(name))
        models.append(ScoreNetwork(score, 1.0))
    for model in models:
        points, origin = recover_waypoints(model)
        assert origin == "box"
        assert PointCloud(points).unit_length == 1.0
        np.testing.assert_array_equal(PointCloud(points).box, [[-5, -5], [5, 5]])
        # Its outline in order, a step of one unit each.
        steps = np.linalg.norm(np.diff([*points, points[0]], axis=0), axis=1)
        np.testing.assert_array_equal(steps, np.ones(32))
        np.testing.assert_array_equal(np.abs(points).max(axis=1), np.full(32, 4.0))


def test_a_wide_ridge_that_leads_on_steeply_is_no_path():
    """As those beside the paths of a badly learned score; its upper end alone is left."""
    share = (np.arange(100) + 0.5) / 100
    along = -np.log(1 - share) / 1.2 - 4.0
    ridge = GaussianMixture(np.column_stack([along, np.zeros(100)]), 0.6)
    points, _ = recover_waypoints(ridge)
    assert points[:, 0].max() < -2.5


def test_a_score_that_is_not_finite_is_refused():
    widths = [3, 4, 4, 2]
    weights = tuple(np.full((b, a), 1e200) for a, b in pairwise(widths))
    biases = tuple(np.zeros(width) for width in widths[1:])
    with pytest.raises(ConfigurationError, match="beyond what float64 can square"):
        recover_waypoints(ScoreNetwork(Perceptron(weights, biases), 1.0))
