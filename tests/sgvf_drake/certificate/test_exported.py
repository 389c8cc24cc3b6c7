"""What a certificate says of a field in a machine's arithmetic."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sgvf_drake import GuidingField, PointCloud, certify
from sgvf_drake.certificate import (
    ARITHMETICS,
    Certificate,
    ExportedField,
    check_exported,
    find_tube,
    prove_rest,
    prove_tube,
    prove_walls,
)
from sgvf_drake.certificate.by_tubes import prove_by_tubes
from sgvf_drake.certificate.field_model import PerturbedField, direction_model, model_field
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import NormalisedComposition, PaperComposition, load_field
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import ReferencePath
from tests.fields import random_field
from tests.helpers import circle

FLOAT, DOUBLE = ARITHMETICS["float"], ARITHMETICS["double"]


@pytest.fixture(scope="module")
def trained():
    """A trained field of two circles."""
    return load_field("tests/data/fields/robust.safetensors")


@pytest.fixture(scope="module")
def steep(ring_networks):
    """A field around a ring whose score is a difference of large numbers: weights of 40,000."""
    return GuidingField.from_torch(*ring_networks, PointCloud(circle(3.0, 100)), gain=0.7)


@dataclass(frozen=True, eq=False)
class Off(PerturbedField):
    """Everything that is no further from a field than a number."""

    most: float

    def error(self, patches):
        return np.full(len(patches), self.most)


def tube_of(field):
    vertices = field.path.pieces[0].vertices
    found = find_tube(field, field.cloud.normalize(vertices), closed=True)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def found(trained):
    """The tube and the walls of the first of its circles."""
    return tube_of(trained)


def test_a_tube_and_its_first_walls_hold_with_the_errors_of_float(trained, found):
    exported = ExportedField(trained, FLOAT)
    assert prove_tube(exported, found.tube).proved
    proof = prove_walls(exported, found.tube, found.walls[:1])
    (left,), exact = proof.e_star, found.walls_proof.e_star[0]
    # What is left is no more than what there was, and no less but for the error.
    assert exact - exported.largest <= left < exact
    assert 1e-5 < exported.largest < 0.01


@pytest.mark.parametrize(
    "composition", [None, PaperComposition(0.8), NormalisedComposition(0.8)]
)
def test_positive_multiples_hold_the_multiples_of_what_is_perturbed(composition):
    """With an error of .3 in any direction, m stays within the models of its direction."""
    field = random_field("robust")
    field = field if composition is None else replace(field, composition=composition)
    rng = np.random.default_rng(0)
    z = rng.uniform(-4, 4, (40, 2))

    patches = Patches(z, np.tile(1e-6 * np.eye(2), (40, 1, 1)))
    model = direction_model(Off(field, 0.3), patches)
    middle = model_field(field, Patches.points(z)).value
    for turn in np.linspace(0, 2 * np.pi, 8):
        m = middle + 0.2999 * np.array([np.cos(turn), np.sin(turn)])
        # Some positive multiple is within the bounds: of no direction is all of it beyond.
        for u in rng.standard_normal((20, 2)):
            most = model.weighted(np.broadcast_to(u, z.shape)).upper[:, 0]
            assert ((most > 0) | (m @ u <= 1e-9)).all()


def test_errors_on_the_border_of_a_ball_of_rest_count():
    field = load_field("tests/data/fields/half_circle.safetensors")
    vertices = field.path.pieces[0].vertices
    found = find_tube(field, field.cloud.normalize(vertices), closed=False)
    exact = prove_rest(field, found.tube.rest)
    assert exact.proved
    for most in (0.2 * exact.inflow, 2 * exact.inflow):
        proof = prove_rest(Off(field, most), found.tube.rest)
        assert proof.rate == exact.rate
        assert proof.inflow < exact.inflow - most
        assert proof.proved == (proof.inflow > 0)
    assert not proof.proved


def test_what_cannot_be_proved_is_told(trained):
    with pytest.raises(
        ConfigurationError, match="nothing bounds the errors of int8; of double"
    ):
        check_exported(None, trained, "int8")


def test_a_certificate_of_one_piece_of_two_is_about_that_one(trained, found):
    path, walls = ReferencePath(trained.path.pieces[:1]), found.walls[:1]
    proof = prove_walls(trained, found.tube, walls)
    known = replace(found, walls=walls, walls_proof=proof)
    certificate = prove_by_tubes(trained, path, lambda *_: known, lambda walls: None)
    assert certificate.certified
    exported = check_exported(certificate, trained, "float")
    assert exported.certified
    (before,), (left,) = exported.e_star, exported.e_star_left
    assert len(before) == len(left) == 1
    assert (np.array(left) >= np.array(before) - exported.error).all()


def test_a_certificate_of_nothing_is_refused(trained):
    certificate = Certificate(certified=True, reason="", field_digest=field_digest(trained))
    with pytest.raises(ConfigurationError, match="certifies nothing"):
        check_exported(certificate, trained, "float")


@pytest.mark.full
def test_a_steep_score_is_followed_in_double_but_not_in_float(steep):
    tube = tube_of(steep).tube
    assert prove_tube(ExportedField(steep, DOUBLE), tube).proved
    exported = ExportedField(steep, FLOAT)
    assert not prove_tube(exported, tube).proved
    assert exported.largest > 0.1


@pytest.mark.full
def test_certificates_as_exported(trained, steep):
    certificate = certify(trained)
    found = check_exported(certificate, trained, "float")
    assert found.certified
    assert found.reason.startswith("certified as exported: m is off by ")
    assert 0 <= certificate.area_fraction - found.area_fraction < 0.01
    for before, left in zip(found.e_star, found.e_star_left, strict=True):
        assert (np.array(left) <= before).all()
        assert (np.array(left) >= np.array(before) - found.error).all()
    with pytest.raises(ConfigurationError, match="another field"):
        check_exported(certificate, replace(trained, seed=1), "float")
    lost = check_exported(certify(steep), steep, "float")
    assert not lost.certified
    assert lost.reason.startswith("NOT certified as exported: m is off by ")
    assert set(lost.e_star_left[0]) == {0.0}
