"""Where nothing is proved of a vehicle's flight, it is said by how much it fails."""

import pytest

from sgvf_drake.certificate import find_tube
from sgvf_drake.certificate.vehicle_claim import prove_piece
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.vehicle_search import VehicleQuestion, propose_flight
from sgvf_drake.fields import load_guiding_field
from tests.data.make import field_file


@pytest.mark.full
def test_what_is_proposed_is_proved_and_not_much_more():
    """On rings of 0.5 and 1 m: the errors at the start are the largest, under a disturbance."""
    field, scale = load_guiding_field(field_file("robust")), 0.25
    question = VehicleQuestion(speed=0.45, scale=scale, approach_rate=1.0)
    answer = propose_flight(field, field.path, question)
    for piece, proposal in zip(field.path.pieces, answer.proposals, strict=True):
        found = find_tube(answer.field, field.cloud.normalize(piece.vertices), closed=True)
        given = (answer.field, found.tube, found.walls, found.walls_proof.e_star, proposal)
        unit = scale * field.cloud.unit_length
        for share, holds in ((1.0, True), (1.2, False)):
            force = share * answer.disturbance
            result = prove_piece(*given, answer.law, unit, force)
            assert (result.failures == ()) == holds


@pytest.mark.full
def test_a_flight_that_is_too_fast_is_not_proposed(flight_field):
    question = VehicleQuestion(speed=2.0, approach_rate=4.0)
    answer = propose_flight(flight_field, flight_field.path, question)
    assert set(answer.proposals) == {None}
    assert answer.reason.startswith("at 4 /s, along piece 1, the desired ")
    assert "the desired angular acceleration" in answer.reason


def test_open_paths_have_no_walls(open_field):
    with pytest.raises(ConfigurationError, match="closed paths in the plane"):
        propose_flight(open_field, open_field.path, VehicleQuestion(0.45))
