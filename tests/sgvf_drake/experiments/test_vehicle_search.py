"""Where nothing is proved of a vehicle's flight, it is said by how much it fails."""

import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.vehicle_search import VehicleQuestion, propose_flight


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
