"""The tables that the commands print, each from a summary."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from sgvf_drake.cli.application import console, errors


def print_messages(messages: Iterable[str]) -> None:
    """Prints what was read from a file."""
    for message in messages:
        console.print(message, markup=False, highlight=False, soft_wrap=True)


def print_training(summary: Mapping[str, Any]) -> None:
    """Prints the summary of a training."""
    rows = {
        "recipe, seed": f"{summary['recipe']}, {summary['seed']}",
        "waypoints": f"{summary['num_points']} in {summary['dim']}-D",
        "unit length U": f"{summary['unit_length']:.4g}",
        "pieces": _pieces(summary["pieces"]),
        **_cleaning(summary),
        "noise level": f"{summary['sigma']:.3g} U",
        "training": f"{summary['train_cpu_s']:.1f} s CPU, {summary['restarts']} restarts",
        "self-check": summary["self_check"]["message"],
    }
    print_table("Training", rows)
    if summary["unsure"]:
        errors.print(f"unsure: {summary['unsure']}", style="bold red", soft_wrap=True)
    if not summary["self_check_passed"]:
        errors.print("warning: the field failed its self-check", style="bold red")


def _pieces(pieces: Sequence[Mapping[str, Any]]) -> str:
    """Returns how many pieces of each kind there are: "1 open, 1 closed"."""
    if any("is" in piece for piece in pieces):
        return "; ".join(piece["is"] for piece in pieces)
    num_closed = sum(piece["closed"] for piece in pieces)
    counts = {"open": len(pieces) - num_closed, "closed": num_closed}
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)


def _cleaning(summary: Mapping[str, Any]) -> dict[str, str]:
    """Returns the rows that tell what was done to the waypoints, if anything was."""
    rows = {}
    if summary["dropped"]:
        rows["strays left out"] = str(summary["dropped"])
    if summary["resampled"]:
        rows["learned from"] = "waypoints resampled along their pieces"
    return rows


def print_import(summary: Mapping[str, Any]) -> None:
    """Prints the summary of an import."""
    origin = {
        "file": "of the file",
        "score": "as the score shows them",
        "box": "a square in their place",
    }
    rows = {
        "score": _architecture(summary["score_layers"], summary["score_activation"]),
        "tangent": _architecture(summary["tangent_layers"], summary["tangent_activation"]),
        "waypoints": (
            f"{summary['num_points']} in {summary['dim']}-D, {origin[summary['points']]}"
        ),
        "unit length U": f"{summary['unit_length']:.4g}",
        "noise level": f"{summary['sigma']:.3g} U",
        "k_s": f"{summary['gain']:.4g}",
        "length of the field": "one" if summary["normalised"] else "as it comes",
    }
    print_table("Import", rows)
    if summary["points"] == "box":
        message = "warning: the score shows no path; give its waypoints with --points"
        errors.print(message, style="bold red")


def _architecture(widths: Sequence[int], activation: str) -> str:
    """Returns a network in short: "3-64-64-2, SiLU"."""
    return f"{'-'.join(map(str, widths))}, {activation}"


def print_following(summary: Mapping[str, Any]) -> None:
    """Prints the summary of following."""
    U = summary["unit_length"]
    # No fraction of laps where every piece is open, none of ends where every one is closed.
    names = ("reach", "lap", "end", "straight", "turn")
    aims = {name: summary.get(f"{name}_fraction") for name in names}
    aims = {name: value for name, value in aims.items() if value is not None}
    rows = {
        "starts": str(summary["starts"]),
        ", ".join(aims): ", ".join(f"{value:.1%}" for value in aims.values()),
        "stall, leave": f"{summary['stall_fraction']:.1%}, {summary['leave_fraction']:.1%}",
        "cross-track RMS": _length(summary["cross_track_rms"], U),
        "cross-track max": _length(summary["cross_track_max"], U),
        "speed on the path": (
            f"{summary['speed_on_path_min']:.3f} to {summary['speed_on_path_max']:.3f}"
        ),
        "reference": summary["reference"],
    }
    print_table("Following", rows)


def _length(value: float | None, unit: float) -> str:
    return "no agent settled" if value is None else f"{value:.4g} ({value / unit:.4f} U)"


def print_flight(summary: Mapping[str, Any]) -> None:
    """Prints the summary of flights, a row a piece."""
    # Headings are broken so that the table fits in 80 columns.
    columns: dict[str, Callable[[Any], str]] = {
        "piece": lambda piece: str(piece["piece"] + 1),
        "RMS\n[m]": lambda piece: _number(piece["cross_track_rms_m"]),
        "max\n[m]": lambda piece: _number(piece["cross_track_max_m"]),
        "speed\n[m/s]": lambda piece: f"{piece['speed_mean_m_s']:.3f}",
        "altitude\nRMS [m]": lambda piece: _number(piece["altitude_rms_m"]),
        "force\n[N]": lambda piece: _number(piece["motor_force_max_n"], 2),
        "satu-\nrated": lambda piece: f"{piece['saturated_fraction']:.1%}",
        _aim(summary["pieces"]): _completion,
        "x real\ntime": lambda piece: f"{piece['real_time_factor']:.0f}",
    }
    console.print(_feasibility(summary), highlight=False)
    print_columns("Flight", columns, summary["pieces"], "right", first="right")
    if "certificate" in summary:
        console.print(_margin(summary["certificate"]), highlight=False)


def _feasibility(summary: Mapping[str, Any]) -> str:
    """Returns in words whether the vehicle can do what the path demands."""
    demand, limit = summary["acceleration_demand_m_s2"], summary["acceleration_limit_m_s2"]
    if demand is not None:
        verdict = "feasible" if demand < limit else "NOT feasible"
        return f"acceleration {demand:.2f} of {limit:.1f} m/s^2: {verdict}"
    demand, limit = summary["curvature_demand_1_m"], summary["curvature_limit_1_m"]
    if demand < limit:
        verdict = "feasible"
    else:
        verdict = f"NOT feasible in bends {demand / limit:.1f} times too tight, turned wide"
    return f"curvature {demand:.3g} of {limit:.3g} 1/m: {verdict}"


def _margin(found: Mapping[str, Any]) -> str:
    """Returns what a certificate says of flights, in words."""
    if found["error_max"] is None:
        return "velocity error: NOT inside of what is proved; not every flight came to walls"
    error = f"velocity error, between walls: up to {found['error_max']:.3g} of the speed"
    if not found["inside_margin"]:
        return f"{error}, NOT inside of what is proved; no walls that were entered tolerate it"
    width = found["covering_half_width"]
    return (
        f"{error}, inside of what is proved: walls within {width:.3g} m of the orbits hold it"
    )


def print_live(summary: Mapping[str, Any]) -> None:
    """Prints what was changed in flights by sliders, a line each, and what ended them."""
    from systems import Change

    flights = summary.get("pieces") or summary.get("routes") or [summary]
    for number, live in enumerate((flight.get("live") for flight in flights), start=1):
        if live is None:
            continue
        lines = [str(Change(**change)) for change in live["changes"]]
        lines += ["stopped by its button"] * live["stopped"]
        flight = f"flight {number}, " if len(flights) > 1 else ""
        for line in lines:
            console.print(f"{flight}{line}", highlight=False, soft_wrap=True)
        if live["lost_control"]:
            message = f"warning: {flight}the vehicle lost control at {live['lost_control']}"
            errors.print(message, style="bold red", soft_wrap=True, markup=False)


def print_tour(summary: Mapping[str, Any]) -> None:
    """Prints the summary of a tour, a row for each leg and each transfer in turn."""

    def flight(part: Mapping[str, Any]) -> str:
        return f"{'along' if 'cross_track_rms_m' in part else 'to'} piece {part['piece'] + 1}"

    def span(part: Mapping[str, Any], low: str, high: str) -> str:
        return f"{part[low]:.2f} - {part[high]:.2f}"

    columns: dict[str, Callable[[Any], str]] = {
        "from [s]": lambda part: f"{part['begin_s']:.1f}",
        "flight": flight,
        "RMS [m]": lambda part: _number(part.get("cross_track_rms_m")),
        "max [m]": lambda part: _number(part.get("cross_track_max_m")),
        "speed [m/s]": lambda part: span(part, "speed_min_m_s", "speed_max_m_s"),
        "force [N]": lambda part: span(part, "motor_force_min_n", "motor_force_max_n"),
    }
    parts = sorted([*summary["legs"], *summary["transfers"]], key=lambda part: part["begin_s"])
    print_columns("Tour", columns, parts, "right", first="right")
    if not summary["completed"]:
        errors.print("warning: the tour was not completed", style="bold red")


def print_routes(summary: Mapping[str, Any]) -> None:
    """Prints the summary of flights along itineraries, a row each."""
    routes = summary.get("routes", [summary])
    columns: dict[str, Callable[[Any], str]] = {
        "edges": lambda route: str(len(route["route"])),
        "length\n[m]": lambda route: f"{route['route_length_m']:.1f}",
        "RMS\n[m]": lambda route: _number(route["cross_track_rms_m"]),
        "max\n[m]": lambda route: _number(route["cross_track_max_m"]),
        "max in\nturns [m]": lambda route: _number(route["turn_error_max_m"]),
        "turns\nmade": lambda route: _share(route["turn_fraction"]),
        "least speed\n[m/s]": lambda route: f"{route['speed_min_m_s']:.2f}",
        "com-\npleted": lambda route: "yes" if route["route_completed"] else "no",
    }
    print_columns("Routes", columns, routes, "right", first="right")
    if not all(route["route_completed"] for route in routes):
        errors.print("warning: the route was not completed", style="bold red")


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _aim(pieces: Sequence[Mapping[str, Any]]) -> str:
    """Returns the heading of what is to be completed: laps, ends, or both."""
    kinds = {"end" if piece["open"] else "laps" for piece in pieces}
    return ",\n".join(sorted(kinds, reverse=True))


def _completion(piece: Mapping[str, Any]) -> str:
    if piece["open"]:
        return "yes" if piece["ended"] else "no"
    return f"{piece['laps']:.2f}"


def _number(value: float | None, digits: int = 4) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def print_columns(
    title: str | None,
    columns: Mapping[str, Callable[[Any], str | Text]],
    rows: Iterable[Any],
    justify: JustifyMethod = "left",
    first: JustifyMethod = "left",
    **layout: Any,
) -> None:
    """Prints a table with one line a row: each column is a heading and what makes a cell.

    The first column, which `first` aligns, is never broken into lines.
    """
    table = Table(title=title, title_justify="left", **layout)
    for number, heading in enumerate(columns):
        # As text, since "[m]" would be markup.
        table.add_column(
            Text(heading), justify=justify if number else first, no_wrap=number == 0
        )
    for row in rows:
        cells = (cell(row) for cell in columns.values())
        table.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in cells))
    console.print(table)


def print_table(title: str, rows: Mapping[str, str]) -> None:
    """Prints rows of a name and a value."""
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)


def print_folder(out: Path) -> None:
    """Prints where the results are."""
    console.print(f"results in {out}", markup=False, highlight=False, soft_wrap=True)
