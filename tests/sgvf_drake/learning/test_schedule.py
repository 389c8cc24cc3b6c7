import pytest
import torch

from sgvf_drake.learning.schedule import SIGMA_MAX, NoiseSchedule


def test_it_runs_from_forgetting_the_cloud_to_the_data():
    schedule = NoiseSchedule(0.1)
    ends = schedule(torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert ends.tolist() == pytest.approx([SIGMA_MAX, 0.1], rel=1e-14)
    assert SIGMA_MAX == 3.0


def test_it_falls_by_equal_factors():
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    sigma = NoiseSchedule(0.05, sigma_max=2.0)(t)
    ratios = sigma[1:] / sigma[:-1]
    assert (ratios < 1).all()
    torch.testing.assert_close(ratios, torch.full((10,), (0.05 / 2) ** 0.1).double())


def test_it_keeps_shape_and_type():
    sigma = NoiseSchedule(0.1)(torch.rand(5, 1, generator=torch.Generator().manual_seed(0)))
    assert sigma.shape == (5, 1)
    assert sigma.dtype == torch.float32
