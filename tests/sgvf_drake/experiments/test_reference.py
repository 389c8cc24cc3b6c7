"""Against the cloud itself, what counts as open is what the field was trained for."""

import numpy as np
import pytest

import sgvf_drake as sgvf
from sgvf_drake.experiments import choose_reference, scale_reference


def trained(points, **config):
    quick = {"recipe": "exact", "tangent_iterations": 20, "max_restarts": 0}
    return sgvf.train(sgvf.PointCloud(points), sgvf.TrainingConfig(**quick, **config)).field


def arc(degrees, count=120):
    angle = np.radians(np.linspace(0, degrees, count))
    return 3 * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(
    ("degrees", "config", "closed"),
    [
        (357, {}, True),
        (357, {"open": True}, False),
        (200, {}, False),
    ],
)
def test_the_tree_is_open_where_the_field_has_an_end(degrees, config, closed):
    field = trained(arc(degrees), **config)
    assert len(field.ends) == (not closed)
    reference, kind = choose_reference(field)
    assert kind == "cloud"
    assert reference.closed.tolist() == [closed]
    travelled = 3 * np.radians(degrees)
    chord = 6 * np.sin(np.radians(degrees) / 2)
    # The tree's chords are shorter than the arc by parts in 10,000.
    assert reference.longest == pytest.approx(travelled + closed * chord, rel=1e-3)


def test_a_scaled_tree_keeps_its_pieces():
    reference, _ = choose_reference(trained(arc(357), open=True))
    scaled = scale_reference(reference, 0.01)
    assert scaled.closed.tolist() == [False]
    assert scaled.longest == pytest.approx(0.01 * reference.longest)
    x = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    here, there = reference.project(x), scaled.project(0.01 * x)
    np.testing.assert_allclose(there.distance, 0.01 * here.distance, atol=1e-12)
    np.testing.assert_allclose(there.arc, 0.01 * here.arc, atol=1e-9)
