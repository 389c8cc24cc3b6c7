"""The command that flies many times, and one of these flights again: montecarlo."""

from collections.abc import Mapping
import logging
from pathlib import Path
from typing import Annotated, Any

import typer

from sgvf_drake.cli.application import app, progress
from sgvf_drake.cli.flying import Compensate, Gust, Wind, wind_of
from sgvf_drake.cli.options import FieldPath, Jobs, Out, Overwrite, Scheduler
from sgvf_drake.cli.tables import print_folder, print_table

MM = 1e3


@app.command()
def montecarlo(
    field: FieldPath,
    out: Out,
    flights: Annotated[int, typer.Option(help="How many.")] = 100,
    distributions: Annotated[
        Path | None,
        typer.Option(help="YAML file of what differs between the flights."),
    ] = None,
    wind: Wind = None,
    gust: Gust = 0.0,
    compensate: Compensate = False,
    speed: Annotated[float, typer.Option(help="Commanded speed, m/s.")] = 0.45,
    altitude: Annotated[float, typer.Option(help="Height of a planar flight, m.")] = 1.0,
    scale: Annotated[float, typer.Option(help="Metres in one unit of the waypoints.")] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="Of a flight, s  \\[default: two laps, or to the end].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of all that is drawn.", min=0)] = 0,
    certificate: Annotated[
        Path | None,
        typer.Option(help="Results of sgvf certify: how many flights stay inside of them?"),
    ] = None,
    replay: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Fly flight N of the results in --out again, and nothing else.",
            min=0,
        ),
    ] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Fly a quadrotor many times from drawn starts, in drawn wind, and count the successes."""
    from sgvf_drake.experiments import (
        MonteCarlo,
        load_distributions,
        replay_flight,
        run_monte_carlo,
    )
    from sgvf_drake.experiments.workers import workers_of

    if replay is not None:
        # Drake tells on its own where every Meshcat listens.
        logging.getLogger("drake").setLevel(logging.WARNING)
        with progress() as report:
            again = replay_flight(out, replay, field, overwrite=overwrite, progress=report)
        _print_replay(replay, again)
        print_folder(out / f"replay_{replay}")
        return
    drawn = load_distributions(distributions)
    if wind is not None:
        drawn.disturbance.wind = list(wind_of(wind))
    if gust > 0:
        drawn.disturbance.gust = gust
    experiment = MonteCarlo(
        field=str(field),
        seed=seed,
        speed=speed,
        altitude=altitude,
        duration=duration,
        compensate=compensate,
        scale=scale,
        certificate=None if certificate is None else str(certificate),
        distributions=drawn,
    )
    with progress() as report, workers_of(scheduler, jobs) as executor:
        summary = run_monte_carlo(
            experiment,
            out,
            flights=flights,
            jobs=jobs,
            executor=executor,
            overwrite=overwrite,
            progress=report,
        )
    _print_flights(summary)
    print_folder(out)


def _print_flights(summary: Mapping[str, Any]) -> None:
    """Prints what the flights say together."""
    low, high = summary["success_low"], summary["success_high"]
    rows = {
        "flights": str(summary["flights"]),
        "successes": f"{summary['success_fraction']:.1%} ({low:.1%} to {high:.1%})",
        **{reason: str(count) for reason, count in summary["reasons"].items()},
        "cross-track RMS": _error(summary),
        "worst flights": ", ".join(map(str, summary["worst"])),
        "flown now": f"{summary['flown']}, {summary['flights_per_s']:.2g} a second",
    }
    if "certificate" in summary:
        proved = summary["certificate"]
        rows["inside of what is proved"] = (
            f"{proved['inside_margin']} of {proved['came_between_walls']} that came to walls"
        )
    print_table("Monte Carlo", rows)


def _error(summary: Mapping[str, Any]) -> str:
    names = ("cross_track_rms_m", "cross_track_rms_low_m", "cross_track_rms_high_m")
    rms, low, high = (summary[name] for name in names)
    if rms is None:
        return "-"
    interval = "" if low is None else f" ({MM * low:.3g} to {MM * high:.3g})"
    return f"{MM * rms:.3g} mm{interval}"


def _print_replay(number: int, row: Mapping[str, Any]) -> None:
    same = {True: "yes, to the last bit", False: "no", None: "it was not flown"}
    rms = row["cross_track_rms_m"]
    rows = {
        "success": "yes" if row["success"] else f"no: {row['reason']}",
        "cross-track RMS": "-" if rms is None else f"{MM * rms:.3g} mm",
        "as in the results": same[row["same"]],
    }
    print_table(f"Flight {number} again", rows)
