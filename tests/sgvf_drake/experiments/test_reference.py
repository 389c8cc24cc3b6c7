"""What fields are measured against: a file, the true shape, or what was found."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError, PointCloudError
from sgvf_drake.experiments import choose_reference
from sgvf_drake.paths import ReferencePath


def test_a_named_shape_is_measured_against_the_truth_and_other_clouds_against_their_network(
    flight_field,
):
    lengths = 2 * np.pi * np.array([1.0, 2.0])
    reference, kind = choose_reference(flight_field)
    assert kind == "shape"
    np.testing.assert_allclose(reference.lengths, lengths, rtol=1e-5)
    reference, kind = choose_reference(flight_field.rescaled(2.0))
    assert kind == "cloud"
    assert reference.closed.all()
    np.testing.assert_allclose(sorted(reference.lengths), 2 * lengths, rtol=1e-2)


def test_the_network_of_a_trained_field_is_open_as_it_was_trained(open_field, exact_field):
    for field, closed in ((open_field, [False]), (exact_field.rescaled(2.0), [True, True])):
        assert choose_reference(field)[0].closed.tolist() == closed


def test_a_file_comes_first(tmp_path, flight_field):
    file = tmp_path / "path.csv"
    file.write_text("x_m,y_m,speed\n0,0,1\n1,0,1\n1,1,1\n")
    reference, kind = choose_reference(flight_field, file)
    assert kind == "file"
    assert isinstance(reference, ReferencePath)
    assert reference.longest == 2.0
    closed, _ = choose_reference(flight_field, file, closed=True)
    assert closed.longest == pytest.approx(2.0 + np.sqrt(2.0))
    swapped, _ = choose_reference(flight_field, file, ["speed", "x_m"])
    assert swapped.pieces[0].vertices[0].tolist() == [1.0, 0.0]
    file.write_text("x y z\n0 0 0\n1 0 0\n1 1 1\n")
    with pytest.raises(ConfigurationError, match=r"path.csv: .* 3 coordinates, the field 2"):
        choose_reference(flight_field, file)
    with pytest.raises(PointCloudError, match=r"none.csv"):
        choose_reference(flight_field, tmp_path / "none.csv")


def test_references_scale(rings, open_field):
    x = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    for reference in (rings, open_field.path):
        scaled = reference.rescaled(0.01)
        assert scaled.closed.tolist() == reference.closed.tolist()
        np.testing.assert_allclose(scaled.lengths, 0.01 * reference.lengths, rtol=1e-12)
        here, there = reference.project(x), scaled.project(0.01 * x)
        np.testing.assert_allclose(there.distance, 0.01 * here.distance, atol=1e-12)
        np.testing.assert_allclose(there.arc, 0.01 * here.arc, atol=1e-9)
