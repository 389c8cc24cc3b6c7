"""The commands for one experiment: run and scenarios."""

from typing import Annotated

import typer

from sgvf_drake.cli.application import app, progress
from sgvf_drake.cli.claims import print_claims, print_exhibits, print_scenarios
from sgvf_drake.cli.options import Jobs, Out, Overwrite
from sgvf_drake.cli.tables import print_folder


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
    overwrite: Overwrite = False,
) -> None:
    """Run an experiment of the paper; trials that are finished in --out are kept."""
    from sgvf_drake.paper import load_scenario, run_scenario

    loaded = load_scenario(scenario, override or (), setting or ())
    with progress() as report:
        summary = run_scenario(loaded, out, jobs=jobs, overwrite=overwrite, progress=report)
    print_claims(summary["claims"])
    print_exhibits(summary)
    print_folder(out)


@app.command()
def scenarios() -> None:
    """List the experiments of the paper."""
    from sgvf_drake.paper import load_scenario, override_names, scenario_names

    listed = {}
    for name in scenario_names():
        loaded = load_scenario(name)
        listed[name] = (loaded.title, loaded.source, override_names(name))
    print_scenarios(listed)
