"""The experiments of the paper; each class is a kind that a scenario names."""

from dataclasses import dataclass


@dataclass
class NoExperiment:
    """Stands where a scenario names no kind."""


KINDS: tuple[type, ...] = ()
"""The kinds of experiment; the name of a class is its tag in a scenario."""

__all__ = ["KINDS", "NoExperiment"]
