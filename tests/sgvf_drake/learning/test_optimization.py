from itertools import pairwise

import pytest
import torch
from torch import nn

from sgvf_drake.learning.optimization import RECORD_EVERY, Optimization, optimize


class Parabola(nn.Module):
    """Two parameters and two loss terms, least at (3, -1)."""

    def __init__(self):
        super().__init__()
        self.p = nn.Parameter(torch.zeros(2))

    def losses(self):
        return {"near": (self.p[0] - 3) ** 2, "far": (self.p[1] + 1) ** 2}


def test_history_and_minimum():
    model = Parabola()
    settings = Optimization(iterations=234, learning_rate=0.1, warmup=10, cosine=True)
    history = optimize(model, model.losses, settings, "score")
    assert list(history.columns) == ["stage", "iteration", "near", "far", "total"]
    assert (history["stage"] == "score").all()
    assert history["iteration"].tolist() == [*range(0, 234, RECORD_EVERY), 233]
    # Recorded before the step: the first record is that of the start.
    assert history.loc[0, ["near", "far", "total"]].tolist() == [9, 1, 10]
    sums = history["near"] + history["far"]
    assert history["total"].to_numpy() == pytest.approx(sums.to_numpy(), rel=1e-6)
    torch.testing.assert_close(model.p.detach(), torch.tensor([3.0, -1.0]), atol=1e-2, rtol=0)


@pytest.mark.parametrize("iterations", [1, 10, 11, 25])
def test_progress_is_told_up_to_the_end(iterations):
    told = []
    model = Parabola()
    history = optimize(
        model, model.losses, Optimization(iterations, 0.1), "tangent", lambda *a: told.append(a)
    )
    assert told[0] == ("tangent", 1, iterations)
    assert told[-1] == ("tangent", iterations, iterations)
    done = [call[1] for call in told]
    assert done == sorted(set(done))
    assert len(history) == len(told)


def test_the_learning_rate_warms_up_and_falls_along_a_half_cosine():
    settings = Optimization(iterations=1000, learning_rate=1.0, warmup=50, cosine=True)
    factors = [settings.factor(step) for step in range(1001)]
    assert factors[0] == pytest.approx(1 / 50)
    assert factors[24] == pytest.approx(0.5)
    assert factors[49] == factors[50] == 1
    assert factors[525] == pytest.approx(0.5)
    assert factors[1000] == pytest.approx(0, abs=1e-15)
    assert all(a < b for a, b in pairwise(factors[:50]))
    assert all(a > b for a, b in pairwise(factors[50:]))


def test_without_warmup_and_cosine_it_is_constant():
    settings = Optimization(iterations=10, learning_rate=1.0)
    assert [settings.factor(step) for step in range(10)] == [1.0] * 10


@pytest.mark.parametrize(("warmup", "factor"), [(0, 1.0), (4, 0.25)])
def test_the_first_step_of_adam_is_the_learning_rate_times_the_factor(warmup, factor):
    model = Parabola()
    optimize(model, model.losses, Optimization(1, 0.1, warmup=warmup), "score")
    expected = factor * torch.tensor([0.1, -0.1])
    torch.testing.assert_close(model.p.detach(), expected, rtol=1e-5, atol=0)


def test_fewer_iterations_than_the_warmup_are_no_error():
    model = Parabola()
    settings = Optimization(iterations=3, learning_rate=0.1, warmup=50, cosine=True)
    assert len(optimize(model, model.losses, settings, "score")) == 2
