"""Where nothing is proved of a vehicle's flight, it is said by how much it fails."""

import re

import pytest

from sgvf_drake.certificate import find_tube
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.vehicle_search import (
    VehicleQuestion,
    excess,
    propose_flight,
    vehicle_law,
    widened,
)
from systems import DEFAULT_GAINS, QuadrotorParameters


@pytest.mark.full
def test_a_flight_that_turns_too_fast_is_not_proposed(flight_field):
    question = VehicleQuestion(speed=0.45, approach_rate=4.0)
    answer = propose_flight(flight_field, flight_field.path, question)
    assert set(answer.proposals) == {None}
    told = re.fullmatch(
        "at 4 /s, along piece 1, velocity errors feed (.+) times what they may be",
        answer.reason,
    )
    assert float(told[1]) > 2
    # Errors feed less the slower the field turns to its path.
    slower = widened(flight_field, question, 1.0)
    points = flight_field.cloud.normalize(flight_field.path.pieces[0].vertices)
    found = find_tube(slower, points, closed=True)
    law = vehicle_law(0.45, QuadrotorParameters(), DEFAULT_GAINS)
    assert excess(slower, found, law, flight_field.cloud.unit_length) < 0.5


def test_open_paths_have_no_walls(open_field):
    with pytest.raises(ConfigurationError, match="closed paths in the plane"):
        propose_flight(open_field, open_field.path, VehicleQuestion(0.45))
