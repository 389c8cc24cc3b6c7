"""The command line: ``sgvf train | follow | fly | demo``.

Commands parse, call the experiments, and print a table; the work is elsewhere.  The heavy
imports (Drake, torch, matplotlib) happen inside the commands, so that ``sgvf --help`` and
a mistyped option answer at once.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
import math
from pathlib import Path
import sys
from typing import Annotated, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text
import typer

from sgvf_drake import __version__
from sgvf_drake.exceptions import ConfigurationError, SgvfError
from sgvf_drake.progress import Progress as Report

BAD_INPUT = 2
# Entries of --direction that leave a piece to the rule.
RULE_ENTRIES = ("", "-")

app = typer.Typer(
    name="sgvf",
    help="Follow a path that exists only as a cloud of points.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()
errors = Console(stderr=True)


class RecipeName(StrEnum):
    """The recipes, as the command line offers them."""

    PAPER = "paper"
    ROBUST = "robust"
    EXACT = "exact"


class DirectionName(StrEnum):
    """The directions of travel, as the command line offers them."""

    CCW = "ccw"
    CW = "cw"
    REVERSE = "reverse"


class SamplingName(StrEnum):
    """How a named shape is sampled."""

    UNIFORM = "uniform"
    RANDOM = "random"


Out = Annotated[Path, typer.Option(help="Folder of the results.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace results in --out.")]
FieldPath = Annotated[
    Path, typer.Argument(metavar="FIELD", help="A field file, or the folder of its training.")
]
Columns = Annotated[
    str | None,
    typer.Option(help="Columns of the coordinates, by name or number from 0: x_m,y_m or 0,1."),
]
ReferenceFile = Annotated[
    Path | None,
    typer.Option(help="True path to measure against: an ordered polyline, in a file."),
]
ReferenceColumns = Annotated[
    str | None, typer.Option(help="Columns of the reference file, as --columns.")
]


@app.command()
def train(
    out: Out,
    points: Annotated[
        Path | None, typer.Option(help="Waypoints in any order: CSV, text or .npy.")
    ] = None,
    shape: Annotated[
        str | None, typer.Option(help="A named shape in place of a file; see `sgvf shapes`.")
    ] = None,
    columns: Columns = None,
    num_points: Annotated[
        int | None, typer.Option(help="Waypoints of the shape  \\[default: 200].")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="Noise of the shape's waypoints, std  \\[default: 0].")
    ] = None,
    sampling: Annotated[
        SamplingName | None, typer.Option(help="Sampling of the shape  \\[default: uniform].")
    ] = None,
    recipe: Annotated[RecipeName, typer.Option(help="How to learn.")] = RecipeName.ROBUST,
    seed: Annotated[int, typer.Option(help="Of every random number of the run.")] = 0,
    is_open: Annotated[
        bool | None,
        typer.Option(
            "--open/--closed",
            help="All pieces are open paths, with ends, or closed  \\[default: as they look].",
        ),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(
            help="Direction of travel: ccw, cw or reverse; or one for each piece, the longest "
            "first, as in cw,-,reverse; - is the rule  \\[default: closed pieces ccw, open "
            "ones from the smaller x].",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y", help="A point near which open paths start, in the waypoints' unit."
        ),
    ] = None,
    sigma: Annotated[
        float | None, typer.Option(help="Noise level in U  \\[default: from the waypoints].")
    ] = None,
    score_iterations: Annotated[
        int | None, typer.Option(help="Steps of the score network  \\[default: of the recipe].")
    ] = None,
    tangent_iterations: Annotated[
        int | None,
        typer.Option(help="Steps of the tangent network  \\[default: of the recipe]."),
    ] = None,
    max_restarts: Annotated[
        int | None,
        typer.Option(help="New attempts after failed self-checks  \\[default: of the recipe]."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Train a guiding field from waypoints."""
    from sgvf_drake.paths import PointCloud, make_shape

    if (points is None) == (shape is None):
        raise ConfigurationError("give either --points FILE or --shape NAME")
    if seed < 0:
        raise ConfigurationError(f"seed cannot be {seed}")
    sampled = {"num_points": num_points, "noise": noise, "sampling": sampling}
    given: dict[str, Any] = {
        name: value for name, value in sampled.items() if value is not None
    }
    overrides: dict[str, Any] = {
        "sigma_min": sigma,
        "score_iterations": score_iterations,
        "tangent_iterations": tangent_iterations,
        "max_restarts": max_restarts,
    }
    of_path: dict[str, Any] = {
        "open": is_open,
        "direction": _directions(direction),
        "start": _point(start),
    }
    _check_recipe(recipe, of_path, score_iterations)
    chosen = _columns(columns, points, "--points")
    if points is not None:
        if given:
            option = f"--{next(iter(given))}".replace("_", "-")
            raise ConfigurationError(f"{option} is for --shape; a file is taken as it is")
        cloud = PointCloud.read(points, chosen)
    else:
        assert shape is not None
        cloud, _ = make_shape(shape, seed=seed, **given)
    # Slow to import, so only once the waypoints are read.
    from sgvf_drake.experiments import run_train
    from sgvf_drake.learning import TrainingConfig

    config = TrainingConfig(recipe=recipe.value, seed=seed, **of_path, **overrides)
    with _progress() as progress:
        summary = run_train(cloud, config, out, overwrite=overwrite, progress=progress)
    _print_training(summary)
    _print_folder(out)


@app.command()
def follow(
    field: FieldPath,
    out: Out,
    starts: Annotated[int, typer.Option(help="Agents, on a grid over the box.")] = 400,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    duration: Annotated[
        float | None, typer.Option(help="Seconds at unit speed  \\[default: 1.5 laps + 15 U].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Follow a field with many kinematic agents from a grid of starts."""
    from sgvf_drake.experiments import choose_reference, open_field, run_follow

    loaded = open_field(field)
    chosen = choose_reference(loaded, reference, _columns(columns, reference, "--reference"))
    with _progress() as progress:
        summary = run_follow(
            loaded,
            chosen,
            out,
            starts=starts,
            duration=duration,
            overwrite=overwrite,
            progress=progress,
        )
    _print_following(summary)
    _print_folder(out)


@app.command()
def fly(
    field: FieldPath,
    out: Out,
    speed: Annotated[float, typer.Option(help="Commanded speed, m/s.")] = 0.45,
    laps: Annotated[float, typer.Option(help="Laps of every closed piece, at least 1.")] = 2.0,
    altitude: Annotated[float, typer.Option(help="Height of a planar flight, m.")] = 1.0,
    scale: Annotated[float, typer.Option(help="Metres in one unit of the waypoints.")] = 1.0,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    overwrite: Overwrite = False,
) -> None:
    """Fly Drake's quadrotor along every piece of the path."""
    from sgvf_drake.experiments import choose_reference, open_field, run_fly, scale_reference

    loaded = open_field(field)
    path, kind = choose_reference(
        loaded, reference, _columns(columns, reference, "--reference")
    )
    metric = loaded.rescaled(scale)
    with _progress() as progress:
        summary = run_fly(
            metric,
            (scale_reference(path, scale), kind),
            out,
            speed=speed,
            laps=laps,
            altitude=altitude,
            overwrite=overwrite,
            progress=progress,
        )
    _print_flight(summary)
    _print_folder(out)


@app.command()
def demo(out: Out = Path("demo"), overwrite: Overwrite = False) -> None:
    """Train on the paper's concentric rings, follow them, and fly each of them."""
    from sgvf_drake.experiments import run_demo

    with _progress() as progress:
        summary = run_demo(out, overwrite=overwrite, progress=progress)
    _print_training(summary["train"])
    _print_following(summary["follow"])
    _print_flight(summary["fly"])
    _print_folder(out)


@app.command()
def shapes() -> None:
    """List the named shapes."""
    from sgvf_drake.paths import SHAPES

    console.print("\n".join(SHAPES))


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
    """Runs the command line; bad input ends in one line on stderr and exit status 2."""
    try:
        app(arguments)
    except (SgvfError, OSError) as error:
        # Not as markup: a message may hold brackets.
        errors.print(f"error: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(BAD_INPUT)


def _columns(columns: str | None, file: Path | None, option: str) -> list[str | int] | None:
    if columns is None:
        return None
    if file is None:
        raise ConfigurationError(f"--columns {columns} chooses columns of {option}; give both")
    return [name.strip() for name in columns.split(",")]


def _directions(text: str | None) -> str | tuple[str | None, ...] | None:
    """Reads --direction: one direction for all pieces, or one for each."""
    if text is None:
        return None
    entries = tuple(_direction(entry.strip()) for entry in text.split(","))
    return entries[0] if len(entries) == 1 else entries


def _direction(entry: str) -> str | None:
    if entry in RULE_ENTRIES:
        return None
    try:
        return DirectionName(entry).value
    except ValueError:
        names = ", ".join(DirectionName)
        raise ConfigurationError(
            f"--direction cannot be {entry!r}; choose {names}, or - for the rule"
        ) from None


def _point(text: str | None) -> tuple[float, ...] | None:
    """Reads --start, a point X,Y or X,Y,Z."""
    if text is None:
        return None
    try:
        point = tuple(float(coordinate) for coordinate in text.split(","))
    except ValueError:
        point = ()
    if len(point) < 2 or not all(map(math.isfinite, point)):
        raise ConfigurationError(f"--start must be a point X,Y, not {text!r}")
    return point


def _check_recipe(
    recipe: RecipeName, of_path: Mapping[str, Any], score_iterations: int | None
) -> None:
    """Refuses options that the recipe would ignore."""
    if recipe is RecipeName.PAPER:
        for name, value in of_path.items():
            if value is not None:
                option = "--closed" if value is False else f"--{name}"
                raise ConfigurationError(
                    f"{option} is not for the recipe paper, which knows no pieces"
                )
    if recipe is RecipeName.EXACT and score_iterations is not None:
        raise ConfigurationError(
            "--score-iterations is not for the recipe exact, which has no score network"
        )


@contextmanager
def _progress() -> Iterator[Report]:
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


def _print_training(summary: Mapping[str, Any]) -> None:
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
    _print_table("Training", rows)
    if not summary["self_check_passed"]:
        errors.print("warning: the field failed its self-check", style="bold red")


def _pieces(pieces: Sequence[Mapping[str, Any]]) -> str:
    """Returns how many pieces of each kind there are: "1 open, 1 closed"."""
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


def _print_following(summary: Mapping[str, Any]) -> None:
    U = summary["unit_length"]
    # No fraction of laps where every piece is open, none of ends where every one is closed.
    aims = {name: summary[f"{name}_fraction"] for name in ("reach", "lap", "end")}
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
    _print_table("Following", rows)


def _length(value: float | None, unit: float) -> str:
    return "no agent settled" if value is None else f"{value:.4g} ({value / unit:.4f} U)"


def _print_flight(summary: Mapping[str, Any]) -> None:
    demand, limit = summary["acceleration_demand_m_s2"], summary["acceleration_limit_m_s2"]
    verdict = "feasible" if demand < limit else "NOT feasible"
    table = Table(title="Flight", title_justify="left")
    # Broken so that the table fits in 80 columns.
    headings = ("piece", "RMS\n[m]", "max\n[m]", "speed\n[m/s]", "altitude\nRMS [m]")
    aim = _aim(summary["pieces"])
    for heading in (*headings, "force\n[N]", "satu-\nrated", aim, "x real\ntime"):
        # As text, since "[m]" would be markup.
        table.add_column(Text(heading), justify="right")
    for piece in summary["pieces"]:
        table.add_row(
            str(piece["piece"] + 1),
            _number(piece["cross_track_rms_m"]),
            _number(piece["cross_track_max_m"]),
            f"{piece['speed_mean_m_s']:.3f}",
            _number(piece["altitude_rms_m"]),
            f"{piece['motor_force_max_n']:.2f}",
            f"{piece['saturated_fraction']:.1%}",
            _completion(piece),
            f"{piece['real_time_factor']:.0f}",
        )
    console.print(f"acceleration {demand:.2f} of {limit:.1f} m/s^2: {verdict}", highlight=False)
    console.print(table)


def _aim(pieces: Sequence[Mapping[str, Any]]) -> str:
    """Returns the heading of what is to be completed: laps, ends, or both."""
    kinds = {"end" if piece["open"] else "laps" for piece in pieces}
    return ",\n".join(sorted(kinds, reverse=True))


def _completion(piece: Mapping[str, Any]) -> str:
    if piece["open"]:
        return "yes" if piece["ended"] else "no"
    return f"{piece['laps']:.2f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _print_table(title: str, rows: Mapping[str, str]) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)


def _print_folder(out: Path) -> None:
    console.print(f"results in {out}", markup=False, highlight=False, soft_wrap=True)
