"""The command for every experiment of the paper: reproduce."""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Annotated, Any

from rich.text import Text
import typer

from sgvf_drake.cli.application import FAILED, app, console, errors, progress
from sgvf_drake.cli.options import Jobs, Out, Overwrite, Scheduler
from sgvf_drake.cli.running import STYLES
from sgvf_drake.cli.tables import print_columns


@app.command()
def reproduce(
    out: Out,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small cases, to see that everything works.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A scenario to run, in place of all; repeatable."),
    ] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Run every experiment of the paper into one report; goes on where it was interrupted."""
    from sgvf_drake.experiments.workers import workers_of
    from sgvf_drake.paper import run_reproduce
    from sgvf_drake.paper.reproduce import REPORT, Status

    with progress() as report, workers_of(scheduler, jobs) as executor:
        summary = run_reproduce(
            out,
            quick=quick,
            only=only or (),
            jobs=jobs,
            executor=executor,
            overwrite=overwrite,
            progress=report,
        )
    _print_reproduction(summary)
    console.print(f"report in {out / REPORT}", markup=False, highlight=False, soft_wrap=True)
    if any(entry["status"] == Status.FAILED for entry in summary["scenarios"].values()):
        raise typer.Exit(FAILED)


def _print_reproduction(summary: Mapping[str, Any]) -> None:
    """Prints how far each scenario has come, with the errors of those that failed."""
    scenarios = summary["scenarios"]

    def status(name: str) -> Text:
        text: str = scenarios[name]["status"]
        return Text(text, style="red" if text == "failed" else "")

    def count(verdict: str) -> Callable[[str], str]:
        found = Counter(
            claim["scenario"] for claim in summary["claims"] if claim["verdict"] == verdict
        )
        # Nothing where there are none.
        return lambda name: str(found[name] or "")

    def seconds(name: str) -> str:
        time_s = scenarios[name]["trial_s"]
        return "" if time_s is None else f"{time_s:.1f}"

    columns: dict[str, Callable[[str], str | Text]] = {
        "scenario": str,
        "": status,
        **{verdict: count(verdict) for verdict in STYLES},
        "trials, s": seconds,
    }
    print_columns("Reproduction", columns, scenarios, justify="right")
    for name, entry in scenarios.items():
        if entry["status"] == "failed":
            text = f"{name} failed: {entry['error']}"
            # Not as markup: a message may hold brackets.
            errors.print(text, markup=False, style="bold red", soft_wrap=True)
