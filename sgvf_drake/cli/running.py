"""The commands for one experiment: run and scenarios."""

from collections.abc import Mapping
from typing import Annotated, Any

from rich.text import Text
import typer

from sgvf_drake.cli.application import app, progress
from sgvf_drake.cli.options import Jobs, Out, Overwrite, Scheduler
from sgvf_drake.cli.tables import print_columns, print_folder

STYLES = {"holds": "green", "holds in part": "yellow", "does not hold": "red"}
"""Of the verdicts."""

# Without lines.
PLAIN: dict[str, Any] = {"box": None, "padding": (0, 2, 0, 0)}


@app.command()
def run(
    scenario: Annotated[
        str,
        typer.Argument(metavar="SCENARIO", help="A name of `sgvf scenarios`, or a .yaml file."),
    ],
    out: Out,
    override: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="An override in the file, as quick; repeatable."),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="An option of the experiment; repeatable."
        ),
    ] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Run an experiment of the paper; trials that are finished in --out are kept."""
    from sgvf_drake.experiments.workers import workers_of
    from sgvf_drake.paper import load_scenario, run_scenario

    loaded = load_scenario(scenario, override or (), setting or ())
    options: dict[str, Any] = {"jobs": jobs, "overwrite": overwrite}
    with progress() as report, workers_of(scheduler, jobs) as executor:
        summary = run_scenario(loaded, out, executor=executor, progress=report, **options)
    if summary["claims"]:
        columns = {
            "verdict": _verdict,
            "claim": lambda claim: f"{claim['statement']} ({claim['source']})",
            "evidence": lambda claim: claim["evidence"],
        }
        print_columns("Claims", columns, summary["claims"], show_lines=True)
    exhibits = {
        "file": lambda exhibit: exhibit["file"],
        "shows": lambda exhibit: Text(exhibit["caption"], style="dim"),
    }
    print_columns(None, exhibits, summary["exhibits"], show_header=False, **PLAIN)
    print_folder(out)


def _verdict(claim: Mapping[str, Any]) -> Text:
    return Text(claim["verdict"], style=STYLES[claim["verdict"]])


@app.command()
def scenarios() -> None:
    """List the experiments of the paper."""
    from sgvf_drake.paper import load_scenario, override_names, scenario_names

    columns = {
        "name": lambda name: name,
        "shows": lambda name: load_scenario(name).title,
        "in the paper": lambda name: load_scenario(name).source,
        "overrides": lambda name: ", ".join(override_names(name)),
    }
    print_columns(None, columns, scenario_names(), **PLAIN)
