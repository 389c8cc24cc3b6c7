from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from sgvf_drake import ConfigurationError, GaussianMixture, PointCloud, TrainingConfig, train
from sgvf_drake.fields import Perceptron, ScoreNetwork, find_activation, recover_waypoints
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.importing import perceptron_from_arrays
from sgvf_drake.paths import make_shape, tree_reference


def dense(path):
    return np.concatenate([piece.sample(4_000) for piece in path.pieces])


# A corner is rounded by about the noise level; on circles, the mean of the density lies inside
# by about sigma^2 / 2 R.
@pytest.mark.parametrize(
    ("shape", "sampling", "sigma", "largest"),
    [
        ("concentric-circles", "uniform", 0.1, 0.006),
        ("concentric-circles", "random", 0.2, 0.05),
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
    pieces = tree_reference(PointCloud(points)).pieces
    assert [piece.closed for piece in pieces] == [True] * len(path.pieces)


def test_the_points_are_distinct_and_the_same_every_time():
    cloud, _ = make_shape("circle", num_points=60)
    points, _ = recover_waypoints(GaussianMixture(cloud.points, 0.3))
    assert pdist(points).min() > 0.1
    again, _ = recover_waypoints(GaussianMixture(cloud.points, 0.3))
    np.testing.assert_array_equal(again, points)


@pytest.fixture(scope="module")
def learned():
    """A score network that the paper's recipe trained on a circle, in the circle's unit."""
    cloud, path = make_shape("circle")
    config = TrainingConfig(recipe="paper", score_iterations=800, tangent_iterations=1)
    network = train(cloud, config).field.score_model.network
    # Its inputs are normalised: x / U, as the circle is centred.
    first = network.weights[0] / [cloud.unit_length, cloud.unit_length, 1]
    return Perceptron((first, *network.weights[1:]), network.biases), path


def test_the_path_of_a_learned_score(learned):
    network, path = learned
    points, origin = recover_waypoints(ScoreNetwork(network, 1.0))
    assert origin == "score"
    # In its unit, the noise level of the training is 0.075.
    distances = cKDTree(dense(path)).query(points)[0]
    assert distances.mean() < 0.05
    assert distances.max() < 0.15
    (piece,) = tree_reference(PointCloud(points)).pieces
    assert piece.closed
    assert piece.length == pytest.approx(6 * np.pi, rel=0.03)


def test_the_path_of_the_fitted_ring(ring_networks):
    score = perceptron_from_arrays(ring_networks[0].state_dict(), find_activation("Tanh"))
    points, origin = recover_waypoints(ScoreNetwork(score, 1.0))
    assert origin == "score"
    # To what its last layer was fitted.
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 3, atol=1e-4)


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_an_untrained_score_shows_no_path(make_sequential, activation):
    """A square stands in, whose cloud has the unit and the box of the paper's shapes."""
    network = make_sequential([3, 64, 64, 2], activation.name, seed=5)
    score = perceptron_from_arrays(network.state_dict(), activation)
    points, origin = recover_waypoints(ScoreNetwork(score, 1.0))
    assert origin == "box"
    cloud = PointCloud(points)
    assert cloud.unit_length == 1.0
    np.testing.assert_array_equal(cloud.box, [[-5, -5], [5, 5]])
    # Its outline in order, a step of one unit each.
    steps = np.linalg.norm(np.diff([*points, points[0]], axis=0), axis=1)
    np.testing.assert_array_equal(steps, np.ones(32))
    np.testing.assert_array_equal(np.abs(points).max(axis=1), np.full(32, 4.0))


def test_a_path_outside_of_the_box_is_not_seen():
    cloud, _ = make_shape("circle")
    far = GaussianMixture(cloud.points + np.array([20.0, 0.0]), 0.3)
    assert recover_waypoints(far)[1] == "box"


def test_a_score_that_is_not_finite_is_refused():
    widths = [3, 4, 4, 2]
    weights = tuple(np.full((b, a), 1e200) for a, b in pairwise(widths))
    biases = tuple(np.zeros(width) for width in widths[1:])
    with pytest.raises(ConfigurationError, match="beyond what float64 can square"):
        recover_waypoints(ScoreNetwork(Perceptron(weights, biases), 1.0))
