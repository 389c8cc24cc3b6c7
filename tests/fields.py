"""Fields that need no training: of random networks, and of scores in closed form."""

from itertools import pairwise

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import (
    FourierFeatures,
    GaussianMixture,
    GuidingField,
    PaperComposition,
    Perceptron,
    RobustComposition,
    ScoreNetwork,
)
from tests.helpers import circle

# A quarter turn, counter-clockwise; one about the diagonal of space, and the plane across that.
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
SPIN = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
ACROSS = np.array([[1, -1, 0] / np.sqrt(2), [1, 1, -2] / np.sqrt(6)])


def random_perceptron(rng, inputs, hidden, outputs, num_frequencies=0):
    """A network of order-one outputs and slopes; NumPy only."""
    features = None
    widths = [inputs, *hidden, outputs]
    if num_frequencies:
        features = FourierFeatures(
            rng.standard_normal((num_frequencies, inputs)), rng.uniform(-3, 3, num_frequencies)
        )
        widths[0] = 2 * num_frequencies
    weights = [rng.standard_normal((b, a)) / np.sqrt(a) for a, b in pairwise(widths)]
    biases = [rng.standard_normal(width) for width in widths[1:]]
    return Perceptron(tuple(weights), tuple(biases), features)


def random_field(recipe, dim=2, seed=0, sigma=0.4, gain=0.8, ends=0, support=0):
    """A field of the form of a recipe with untrained networks, off the origin and the unit.

    Robots come to rest at as many of its waypoints as it has ends; with a support, the
    exact score is that of as many other points.
    """
    rng = np.random.default_rng(seed)
    frequencies = 0 if recipe == "paper" else 6
    cloud = PointCloud(3 + 2 * rng.uniform(-1, 1, (30, dim)), shape="random")
    other = 3 + 2 * np.random.default_rng(seed + 1).uniform(-1, 1, (support, dim))
    learned = other if support else cloud.points
    score_model = (
        GaussianMixture(cloud.normalize(learned), sigma)
        if recipe == "exact"
        else ScoreNetwork(
            random_perceptron(rng, dim + 1, (9, 8), dim, frequencies),
            1.0 if recipe == "paper" else sigma,
        )
    )
    composition = (
        PaperComposition(gain) if recipe == "paper" else RobustComposition(gain, sigma)
    )
    return GuidingField(
        cloud=cloud,
        sigma=sigma,
        score_model=score_model,
        tangent_network=random_perceptron(rng, dim, (7,), dim, frequencies),
        composition=composition,
        recipe=recipe,
        seed=seed,
        support=other if support else None,
        end_points=cloud.points[:ends] if ends else None,
        provenance={"training": {"iterations": 7, "hidden": [9, 8]}},
    )


def linear_network(matrix, point=(0.0, 0.0)):
    """The network N(z) = matrix (z - point), normalised units."""
    matrix = np.asarray(matrix, dtype=np.float64)
    return Perceptron((matrix,), (-matrix @ np.asarray(point, dtype=np.float64),))


def exact_field(points, tangent=TURN, sigma=0.1, gain=0.2, composition="robust"):
    """A field with the closed-form score of waypoints.

    Its tangent is a network, or the linear one of a matrix, by default the rotation.
    """
    cloud = points if isinstance(points, PointCloud) else PointCloud(points)
    kinds = {"robust": RobustComposition(gain, sigma), "paper": PaperComposition(gain)}
    return GuidingField(
        cloud=cloud,
        sigma=sigma,
        score_model=GaussianMixture(cloud.normalize(cloud.points), sigma),
        tangent_network=tangent if isinstance(tangent, Perceptron) else linear_network(tangent),
        composition=kinds[composition],
        recipe="exact",
        seed=0,
    )


def tilted_circle():
    """The exact score of a circle of radius 4 about the diagonal of space, and its points."""
    points = circle(4.0, 80) @ ACROSS
    tangent = linear_network(SPIN, np.zeros(3))
    return exact_field(points, tangent, sigma=0.4, gain=0.8), points
