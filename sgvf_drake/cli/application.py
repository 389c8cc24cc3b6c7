"""The application that the commands register with, and how it ends."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import sys
from typing import Annotated, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
import typer

from sgvf_drake import __version__
from sgvf_drake.exceptions import ExperimentError, SgvfError
from sgvf_drake.progress import Progress as Report

# Exit statuses.
FAILED, BAD_INPUT = 1, 2

app = typer.Typer(
    name="sgvf",
    help="Follow a path that exists only as a cloud of points.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)


def _version(value: bool) -> None:
    if value:
        console.print(f"sgvf_drake {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")
    ] = False,
) -> None:
    """Follow a path that exists only as a cloud of points."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; what is wrong is told in one line on stderr.

    The exit status is 2 for bad input, and 1 for an experiment of which trials failed, or where
    another package named `systems` hides ours.
    """
    try:
        app(arguments)
    except (SgvfError, OSError) as error:
        _tell(f"error: {error}")
        sys.exit(FAILED if isinstance(error, ExperimentError) else BAD_INPUT)
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "systems":
            raise
        _tell(
            f"error: {error}: another package of that name comes before the one of sgvf_drake; "
            "use a folder and an environment without it"
        )
        sys.exit(FAILED)


def _tell(message: str) -> None:
    """Prints a message on stderr, in one line; it may hold brackets, so it is no markup."""
    errors.print(message, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress() -> Iterator[Report]:
    """A progress bar a stage, on a terminal only."""
    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    )
    tasks: dict[str, Any] = {}

    def report(stage: str, done: float, total: float) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total)
        bars.update(tasks[stage], completed=done, total=total)

    with bars:
        yield report
