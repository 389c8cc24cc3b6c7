"""One optimisation loop, shared by the score and the tangent network."""

from collections.abc import Callable
from dataclasses import dataclass
import math

import pandas as pd
import torch
from torch import Tensor, nn

from sgvf_drake.progress import Progress, no_progress

# The history keeps a record every so many iterations, and the last one.
RECORD_EVERY = 10


@dataclass(frozen=True)
class Optimization:
    """Adam over a fixed number of iterations.

    Attributes:
        iterations: Number of steps.
        learning_rate: Its largest value.
        warmup: Steps over which the learning rate rises linearly from zero.
        cosine: Whether it falls to zero along a half cosine after that.
    """

    iterations: int
    learning_rate: float
    warmup: int = 0
    cosine: bool = False

    def factor(self, step: int) -> float:
        """Returns the learning rate at a step, as a fraction of the largest."""
        if step < self.warmup:
            return (step + 1) / self.warmup
        if not self.cosine:
            return 1.0
        done = (step - self.warmup) / max(1, self.iterations - self.warmup)
        return 0.5 * (1 + math.cos(math.pi * done))


def optimize(
    network: nn.Module,
    losses: Callable[[], dict[str, Tensor]],
    settings: Optimization,
    stage: str,
    progress: Progress = no_progress,
) -> pd.DataFrame:
    """Minimises the sum of the loss terms over the parameters of `network`, in place.

    Args:
        network: What is trained.
        losses: Draws a batch and returns its weighted loss terms by name.
        settings: Iterations and learning rate.
        stage: Name of this training, for the history and the progress.
        progress: Told how far it is.

    Returns:
        The history: columns stage, iteration, one column a term, and total.
    """
    # Fused: all parameters in one call, which on small networks halves the step.
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, settings.factor)
    records = []
    for iteration in range(settings.iterations):
        terms = losses()
        total = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(total)
        optimizer.step()
        schedule.step()
        if iteration % RECORD_EVERY == 0 or iteration == settings.iterations - 1:
            values = {name: term.item() for name, term in terms.items()}
            records.append({"iteration": iteration, **values, "total": total.item()})
            progress(stage, iteration + 1, settings.iterations)
    history = pd.DataFrame.from_records(records)
    history.insert(0, "stage", stage)
    return history
