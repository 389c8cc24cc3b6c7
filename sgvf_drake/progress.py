"""How long-running functions tell how far they are."""

from typing import Protocol


class Progress(Protocol):
    """Called now and then: what is being done, how far it is, and how much there is."""

    def __call__(self, stage: str, done: float, total: float) -> None: ...


def no_progress(stage: str, done: float, total: float) -> None:
    """The progress that nobody watches."""
