"""The command line: ``python -m sgvf_drake.experiments.quality``."""

from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Annotated

from rich.console import Console
import typer

from sgvf_drake.exceptions import SgvfError
from sgvf_drake.experiments.quality.cases import Suite, suite_cases
from sgvf_drake.experiments.quality.running import print_summary, run_suite
from sgvf_drake.experiments.workers import workers_of

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def _run(
    out: Annotated[Path, typer.Option(help="Folder of the results.")],
    suite: Annotated[Suite, typer.Option(help="Which cases to run.")] = Suite.SMALL,
    seeds: Annotated[int | None, typer.Option(help="Number of seeds, from 0.")] = None,
    starts: Annotated[int | None, typer.Option(help="Number of starts of each case.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes that run cases.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers run them.")
    ] = None,
    circuits: Annotated[
        Path | None, typer.Option(help="Folder of ordered paths, .csv, to add as cases.")
    ] = None,
    any_code: Annotated[
        bool, typer.Option("--any-code", help="Keep finished cases of other code.")
    ] = False,
) -> None:
    """Measures the quality of learning; what is finished in --out is not run again."""
    console = Console()

    def report(stage: str, done: float, total: float) -> None:
        line = f"[{done:.0f}/{total:.0f}] {stage}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    cases = suite_cases(suite, seeds, starts, circuits)
    with workers_of(scheduler, jobs) as executor:
        table = run_suite(cases, out, report, jobs=jobs, executor=executor, any_code=any_code)
    print_summary(table, console)
    if table["error"].notna().any():
        raise typer.Exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; bad input ends in one line on stderr and exit status 2."""
    try:
        app(arguments)
    except (SgvfError, OSError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
