"""Fields that need no training: of random networks, and of scores in closed form."""

from itertools import pairwise

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import (
    DirectedField,
    FourierFeatures,
    GaussianMixture,
    GuidingField,
    NormalisedComposition,
    PaperComposition,
    Perceptron,
    RobustComposition,
    ScoreNetwork,
    StrandMixture,
    StrandNetwork,
)
from tests.helpers import circle

RECIPES = ("robust", "exact", "paper")
# Every way to put score and tangent together.
COMPOSITIONS = {
    "paper": PaperComposition(0.8),
    "normalised": NormalisedComposition(0.8),
    "robust": RobustComposition(0.8, 0.4),
    "unprojected": RobustComposition(0.8, 0.4, projects=False),
}
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


DIRECTED_SIGMA = 0.4
DIRECTED_KINDS = ("one-way", "two-way", "both", "learned one-way", "learned two-way")


def random_strands(kind, dim):
    """Strands of one of the kinds, untrained."""
    rng = np.random.default_rng(1)
    if kind.startswith("learned"):
        features = FourierFeatures(rng.normal(size=(8, dim)), rng.normal(size=8), passed=dim)
        widths = [features.num_outputs, 12, 12, 2 * dim]
        weights = tuple(rng.normal(size=(b, a)) / np.sqrt(a) for a, b in pairwise(widths))
        biases = tuple(rng.normal(size=width) for width in widths[1:])
        network = Perceptron(weights, biases, features)
        return StrandNetwork(network, DIRECTED_SIGMA, two_way=kind.endswith("two-way"))
    points = rng.uniform(-1, 1, (30, dim))
    directions = rng.normal(size=(30, dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    one_way = {"one-way": np.ones(30, bool), "two-way": np.zeros(30, bool)}.get(
        kind, np.arange(30) < 12
    )
    return StrandMixture(points, directions, one_way, DIRECTED_SIGMA)


def random_directed_field(kind, dim, ends=False):
    """A directed field of such strands, off the origin and the unit."""
    rng = np.random.default_rng(2)
    cloud = PointCloud(rng.uniform(-3, 5, (40, dim)))
    return DirectedField(
        cloud=cloud,
        sigma=DIRECTED_SIGMA,
        composition=RobustComposition(2 * DIRECTED_SIGMA, DIRECTED_SIGMA),
        recipe="exact",
        seed=3,
        end_points=cloud.points[:2] if ends else None,
        strands=random_strands(kind, dim),
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
