"""Singularities of guiding fields: kinds, the theorem of Poincare and Hopf, and units."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from sgvf_drake.fields import NormalisedComposition, ScoreField
from sgvf_drake.lyapunov import find_singularities, kind_of
from tests.fields import tilted_circle

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
SKEW = np.array([[2.0, 1.0], [0.3, 1.5]])


@pytest.mark.parametrize(
    ("jacobian", "kind"),
    [
        (np.diag([1.0, 2.0]), "source"),
        (np.diag([-3.0, -1e-3]), "sink"),
        (np.diag([1.0, -1e-4]), "saddle"),
        (np.eye(2), "source"),
        # A double eigenvalue with one eigenvector, which rounding makes complex.
        (np.array([[-1.0, 1.0], [0.0, -1.0]]), "sink"),
        (TURN, "centre"),
        (-5 * TURN, "centre"),
        (TURN + 1e-3 * np.eye(2), "focus"),
        (TURN - np.eye(2), "focus"),
        (np.diag([1.0, 2.0, 3.0]), "source"),
        (np.diag([-1.0, -2.0, -3.0]), "sink"),
        (np.diag([-1.0, 2.0, 3.0]), "saddle"),
        (block_diag(TURN - np.eye(2), -2.0), "focus"),
        (block_diag(TURN - np.eye(2), 2.0), "saddle"),
        (block_diag(TURN, 2.0), "centre"),
    ],
)
def test_kinds_follow_from_the_eigenvalues(jacobian, kind):
    assert kind_of(jacobian) == kind
    # They do not depend on the coordinates, nor on a positive factor.
    skew = block_diag(SKEW, 1.0) if len(jacobian) == 3 else SKEW
    moved = skew @ jacobian @ np.linalg.inv(skew)
    assert kind_of(1e-4 * moved) == kind


@pytest.fixture(scope="module")
def opened(open_field):
    """Those of a trained field along an open path."""
    return find_singularities(open_field)


@pytest.mark.parametrize(
    "trained", ["robust_zeros", pytest.param("opened", marks=pytest.mark.full)]
)
def test_indices_sum_up_to_the_winding_number(trained, request):
    found = request.getfixturevalue(trained)
    assert list(found.by_field) == ["guiding", "score", "tangent"]
    for name, zeros in found.by_field.items():
        assert zeros.index_sum == zeros.winding_number, name
        assert {zero.field for zero in zeros.zeros} == {name}
    # Both point inward on the border of the box.
    assert found.guiding.winding_number == found.score.winding_number == 1
    assert found.guiding.undecided == 0
    for zero in found.guiding.zeros:
        assert zero.residual < 1e-9
        assert (zero.index == -1) == (zero.kind == "saddle")


@pytest.mark.parametrize(("recipe", "seed"), [("robust", 0), ("exact", 3), ("paper", 2)])
def test_they_do_for_untrained_fields_too(make_field, recipe, seed):
    found = find_singularities(make_field(recipe, seed=seed))
    for zeros in found.by_field.values():
        assert zeros.index_sum == zeros.winding_number
        assert zeros.undecided == 0
        assert all(zero.residual < 1e-9 for zero in zeros.zeros)


@pytest.mark.full
def test_robots_rest_where_an_open_path_ends(open_field, opened):
    stable = [zero for zero in opened.guiding.zeros if zero.stable]
    assert [zero.kind for zero in stable] == ["sink"]
    gap = np.linalg.norm(stable[0].point - open_field.ends[0])
    assert gap < open_field.mixture.sigma


def test_the_zeros_of_a_learned_score_come_in_pairs_but_for_one(robust_zeros):
    # Two rings: their maxima and saddles cancel, and so do minima and saddles in between;
    # what is left over is the hole of the inner ring.
    kinds = Counter(zero.kind for zero in robust_zeros.score.zeros)
    assert set(kinds) == {"source", "sink", "saddle"}
    assert kinds["source"] + kinds["sink"] == kinds["saddle"] + 1


def test_normalising_moves_no_zero(make_field):
    field = make_field("paper", seed=2)
    gain = field.composition.gain
    normalised = replace(field, composition=NormalisedComposition(gain))
    ours, theirs = (find_singularities(one).guiding for one in (field, normalised))
    assert ours.zeros
    assert np.array_equal(ours.points, theirs.points)
    assert [zero.kind for zero in ours.zeros] == [zero.kind for zero in theirs.zeros]
    # The winding number is of the same turns.
    assert theirs.winding_number == ours.winding_number
    near = normalised.value_and_jacobian(theirs.points)[1]
    assert [kind_of(J) for J in near] == [zero.kind for zero in theirs.zeros]


def test_zeros_have_the_unit_of_the_waypoints(make_field):
    factor, field = 1e3, make_field("robust", seed=1)
    ours, scaled = find_singularities(field), find_singularities(field.rescaled(factor))
    for name, zeros in ours.by_field.items():
        theirs = scaled.by_field[name]
        assert np.allclose(theirs.points, factor * zeros.points, rtol=1e-7)
        assert [zero.kind for zero in theirs.zeros] == [zero.kind for zero in zeros.zeros]


def test_a_zero_on_the_border_of_the_box_is_in_a_larger_one(ring_field, linear):
    field, _ = ring_field((4.0,), tangent=linear(np.eye(2), (5.0, 1.0)))
    lower, upper = field.cloud.box
    found = find_singularities(field)
    assert np.allclose(found.box[1] - found.box[0], 1.001 * (upper - lower))
    assert found.tangent.index_sum == found.tangent.winding_number == 1
    assert np.allclose(found.tangent.points, [field.cloud.denormalize([5, 1])])


def test_those_of_a_circle_in_space():
    found = find_singularities(tilted_circle()[0])
    # By symmetry they are on its axis: there v is zero, and the score points to the centre.
    (centre,) = found.guiding.zeros
    assert np.abs(centre.point).max() < 1e-9
    assert (centre.kind, centre.index, centre.stable) == ("saddle", -1, False)
    assert (centre.eigenvalues.real > 0).sum() == 2
    assert found.guiding.undecided == 0
    # The waypoints are so close together that the score vanishes all along the circle.
    simple = [zero for zero in found.score.zeros if zero.kind != "degenerate"]
    assert [zero.kind for zero in simple] == ["saddle"]
    assert np.abs(simple[0].point).max() < 1e-9
    assert found.score.undecided == found.tangent.undecided == 1
    assert all(zeros.winding_number is None for zeros in found.by_field.values())


def test_the_zeros_are_those_of_the_parts(robust_field, robust_zeros):
    field, robust = robust_field, robust_zeros
    assert np.abs(field(robust.guiding.points)).max() < 1e-9
    assert np.abs(field.score(robust.score.points)).max() < 1e-9
    assert np.abs(field.tangent(robust.tangent.points)).max() < 1e-9
    J = ScoreField(field).value_and_jacobian(robust.score.points)[1]
    eigenvalues = np.array([zero.eigenvalues for zero in robust.score.zeros])
    assert np.allclose(eigenvalues.sum(axis=1), np.trace(J, axis1=1, axis2=2))
    assert np.allclose(eigenvalues.prod(axis=1), np.linalg.det(J))
