"""The noise schedule of the variance-exploding forward process."""

from dataclasses import dataclass

import torch
from torch import Tensor

# Noise at t = 0: about the half-extent of the normalised cloud, so that p_0 forgets it.
SIGMA_MAX = 3.0


@dataclass(frozen=True)
class NoiseSchedule:
    """sigma(t) = sigma_max^(1 - t) sigma_min^t: geometric, t = 1 is the data end.

    The paper writes its SDE with growing noise (Section II-B) but evaluates the score of
    the data at t = 1; time runs the second way here.

    Attributes:
        sigma_min: Noise level at t = 1, normalised units.
        sigma_max: Noise level at t = 0.
    """

    sigma_min: float
    sigma_max: float = SIGMA_MAX

    def __call__(self, t: Tensor) -> Tensor:
        """Returns sigma(t), elementwise."""
        ratio = torch.tensor(self.sigma_min / self.sigma_max, dtype=t.dtype)
        return self.sigma_max * ratio**t
