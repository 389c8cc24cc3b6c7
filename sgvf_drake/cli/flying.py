"""The commands that try a field out: follow, fly, and demo, which trains one before."""

import logging
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from sgvf_drake.cli.application import app, console, errors, progress
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import (
    print_flight,
    print_folder,
    print_following,
    print_live,
    print_messages,
    print_routes,
    print_tour,
    print_training,
)
from sgvf_drake.exceptions import ConfigurationError

# Relative resolution of the numbers in a browser's scene, and what a quadrotor needs, in m.
SINGLE_PRECISION, SHARP = 2.0**-23, 0.01

Wind = Annotated[
    str | None, typer.Option(help="Mean wind, m/s, as 2,0 or 2,0,0.5; it drags the vehicle.")
]
Gust = Annotated[
    float, typer.Option(help="Standard deviation of gusts on each axis, m/s.", min=0)
]
Compensate = Annotated[
    bool,
    typer.Option(
        "--compensate",
        help="Let the controller estimate what disturbs it, and make up for it.",
    ),
]


@app.command()
def follow(
    field: FieldPath,
    out: Out,
    starts: Annotated[
        int | None,
        typer.Option(
            help="Agents, on a grid over the box  \\[default: 400; of a directed field 100]."
        ),
    ] = None,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    duration: Annotated[
        float | None, typer.Option(help="Seconds at unit speed  \\[default: 1.5 laps + 15 U].")
    ] = None,
    route: Annotated[
        str | None,
        typer.Option(
            help="Edges to run along, as 1,2,-3, where paths cross or branch; - is backwards  "
            "\\[default: straight on]."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Of the headings at the start, where paths cross or branch.")
    ] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Follow a field with many kinematic agents from a grid of starts."""
    from sgvf_drake.experiments import choose_reference, open_field, run_follow
    from sgvf_drake.fields import DirectedField

    loaded = open_field(field)
    chosen = None
    names = columns_of(columns, reference, "--reference")
    if isinstance(loaded, DirectedField):
        if reference is not None:
            raise ConfigurationError(
                f"--reference {reference}: a field of paths that cross or branch is measured "
                "against its own network"
            )
    else:
        chosen = choose_reference(loaded, reference, names)
        print_messages(chosen[0].messages)
    options: dict[str, Any] = {
        "starts": starts,
        "duration": duration,
        "route": route,
        "seed": seed,
        "overwrite": overwrite,
    }
    with progress() as report:
        summary = run_follow(loaded, chosen, out, **options, progress=report)
    print_following(summary)
    print_folder(out)


@app.command()
def fly(
    field: FieldPath,
    out: Out,
    vehicle: Annotated[
        str, typer.Option(help="What flies: quadrotor, multibody, unicycle or fixed-wing.")
    ] = "quadrotor",
    speed: Annotated[
        float | None,
        typer.Option(help="Commanded speed, m/s  \\[default: 0.45; of a fixed wing 15]."),
    ] = None,
    turn_radius: Annotated[
        float | None,
        typer.Option(
            help="Of the tightest turn of a unicycle or a fixed wing, m  \\[default: what 2 "
            "rad/s or a bank of 35 degrees allow at the speed]."
        ),
    ] = None,
    laps: Annotated[
        float | None,
        typer.Option(
            help="Laps of closed pieces, at least 1  \\[default: 2; of a tour or a route 1]."
        ),
    ] = None,
    altitude: Annotated[float, typer.Option(help="Height of a planar flight, m.")] = 1.0,
    scale: Annotated[float, typer.Option(help="Metres in one unit of the waypoints.")] = 1.0,
    tour: Annotated[
        str | None,
        typer.Option(help="Pieces to fly in one flight, in this order: 1,2,1."),
    ] = None,
    route: Annotated[
        str | None,
        typer.Option(
            help="Edges to fly along where paths cross or branch: 1,2,-3, where -3 is edge 3 "
            "from its end to its start."
        ),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(
            help="Where paths cross or branch, the point to fly to the shortest way, in the "
            "unit of the waypoints: 3.5,-2."
        ),
    ] = None,
    cover: Annotated[
        bool,
        typer.Option(
            "--cover",
            help="Fly over every edge where paths cross or branch, as without an option.",
        ),
    ] = False,
    heading: Annotated[
        str | None,
        typer.Option(
            help="Where the quadrotor looks: path, along it; X,Y, towards that point in the "
            "unit of the waypoints; or a fixed yaw in degrees  \\[default: 0]."
        ),
    ] = None,
    jerk_feedforward: Annotated[
        bool,
        typer.Option(
            "--jerk-feedforward",
            help="Tell the quadrotor how its command changes, so that it turns exactly as the "
            "field asks.",
        ),
    ] = False,
    sensors: Annotated[
        bool, typer.Option("--sensors", help="Measure with noise and delay, at 100 Hz.")
    ] = False,
    wind: Wind = None,
    gust: Gust = 0.0,
    compensate: Compensate = False,
    seed: Annotated[
        int, typer.Option(help="Seed of the noise of --sensors and of --gust.", min=0)
    ] = 0,
    html: Annotated[
        bool, typer.Option("--html", help="Save recordings: pages that open offline.")
    ] = False,
    meshcat: Annotated[
        bool,
        typer.Option(
            "--meshcat",
            help="Show it live in a browser, at real time, with sliders that change it.",
        ),
    ] = False,
    tube: Annotated[
        Path | None,
        typer.Option(
            help="Results of sgvf verify or certify: --html and --meshcat show tube or walls."
        ),
    ] = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            help="Results of sgvf certify: do the proved walls tolerate the velocity error?"
        ),
    ] = None,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    overwrite: Overwrite = False,
) -> None:
    """Fly a vehicle along every piece of the path, a route, or from piece to piece."""
    from sgvf_drake.experiments import (
        CertifiedField,
        FlightSpec,
        choose_reference,
        open_field,
        run_fly,
        run_routes,
        run_tour,
    )
    from sgvf_drake.fields import DirectedField
    from systems import (
        DEFAULT_GAINS,
        DISTURBANCE_BANDWIDTH,
        Quadrotor,
        SensorParameters,
        VehicleNamed,
    )

    _check_exclusive(tour, route, to, cover)
    pieces = None if tour is None else _pieces_of(tour)
    if tour is not None and certificate is not None:
        raise ConfigurationError(
            f"--certificate {certificate} says nothing of a tour: transfers leave the field"
        )
    craft = VehicleNamed(vehicle)
    own = {
        "--html": html,
        "--meshcat": meshcat,
        "--heading": heading is not None,
        "--jerk-feedforward": jerk_feedforward,
    }
    given = [name for name, value in own.items() if value]
    if given and not issubclass(craft, Quadrotor):
        raise ConfigurationError(f"{given[0]} is for quadrotors only, no {vehicle}")
    speed = craft.default_speed if speed is None else speed
    loaded = open_field(field)
    directed = isinstance(loaded, DirectedField)
    yaw, looks = _heading_of(heading, scale)
    spec = FlightSpec(
        vehicle=vehicle,
        speed=speed,
        turn_radius=turn_radius,
        laps=laps if laps is not None else 1.0 if directed or tour else 2.0,
        altitude=altitude,
        sensors=SensorParameters() if sensors else None,
        disturbance=_disturbance_of(wind, gust),
        gains=DEFAULT_GAINS._replace(
            heading=yaw, disturbance_bandwidth=DISTURBANCE_BANDWIDTH if compensate else 0.0
        ),
        heading=looks,
        jerk_feedforward=jerk_feedforward,
        seed=seed,
    )
    # Drake tells on its own where every Meshcat listens.
    logging.getLogger("drake").setLevel(logging.WARNING)
    path, kind = choose_reference(
        loaded, reference, columns_of(columns, reference, "--reference")
    )
    print_messages(path.messages)
    _warn_of_ground(loaded, scale)
    options: dict[str, Any] = {"overwrite": overwrite}
    if isinstance(loaded, DirectedField):
        if certificate or tube:
            raise ConfigurationError(
                f"{certificate or tube} is of a field of the position alone; the field follows "
                "paths that cross or branch"
            )
    elif route is not None or to is not None or cover:
        raise ConfigurationError(
            "--route, --to and --cover are for fields of paths that cross or branch"
        )
    elif certificate is not None:
        options["certified"] = CertifiedField.open(loaded, certificate, speed, scale)
    if tube is not None and not (html or meshcat):
        raise ConfigurationError(f"--tube {tube} is shown by --html or --meshcat; give one")
    if html or meshcat:
        options["view"] = _view(loaded, scale, speed, html, meshcat, tube or certificate)
    metric, chosen = loaded.rescaled(scale), (path.rescaled(scale), kind)
    shown = print_flight
    with progress() as report:
        options["progress"] = report
        if pieces is not None:
            summary, shown = run_tour(metric, chosen, out, pieces, spec, **options), print_tour
        elif isinstance(metric, DirectedField):
            routes = _routes_of(metric, spec, route, to, scale)
            summary, shown = run_routes(metric, routes, out, spec, **options), print_routes
        else:
            summary = run_fly(metric, chosen, out, spec, **options)
    shown(summary)
    print_live(summary)
    print_folder(out)


def _check_exclusive(tour: str | None, route: str | None, to: str | None, cover: bool) -> None:
    """Refuses two options that each say where to fly."""
    given = {"--tour": tour, "--route": route, "--to": to, "--cover": cover or None}
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise ConfigurationError(f"{' and '.join(names)} exclude each other; give one")


def _routes_of(
    field: Any, spec: Any, route: str | None, to: str | None, scale: float
) -> list[Any]:
    """Returns the itineraries to be flown; without an option over every edge of each piece."""
    from sgvf_drake.experiments import covering_routes, to_point
    from sgvf_drake.paths.itinerary import Itinerary

    network = field.network
    if route is not None:
        return [Itinerary.parse(route, network)]
    if to is not None:
        try:
            target = [scale * float(x) for x in to.split(",")]
        except ValueError:
            raise ConfigurationError(f"--to {to} is no point, as 3.5,-2 is") from None
        return [to_point(network, target, spec)]
    return covering_routes(network)


def _disturbance_of(wind: str | None, gust: float) -> Any:
    """Reads --wind and --gust; None without either."""
    from systems import Disturbance

    if wind is None and gust == 0:
        return None
    return Disturbance(wind=wind_of(wind or "0,0"), gust=gust)


def wind_of(wind: str) -> tuple[float, float, float]:
    """Reads --wind."""
    try:
        air = [float(speed) for speed in wind.split(",")]
    except ValueError:
        air = []
    if len(air) not in (2, 3):
        raise ConfigurationError(f"--wind {wind} is no velocity, as 2,0 or 2,0,0.5 is")
    return air[0], air[1], air[2] if len(air) == 3 else 0.0


def _heading_of(heading: str | None, scale: float) -> tuple[float, Any]:
    """Reads --heading: a fixed yaw in rad, and what is looked at in its place, or None."""
    if heading in (None, "path"):
        return 0.0, heading
    try:
        numbers = [float(number) for number in heading.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2) or not all(map(math.isfinite, numbers)):
        raise ConfigurationError(
            f"--heading {heading} is none, as path, 90 or the point 3.5,-2 is"
        )
    if len(numbers) == 1:
        return math.radians(numbers[0]), None
    return 0.0, (scale * numbers[0], scale * numbers[1])


def _pieces_of(tour: str) -> list[int]:
    """Reads --tour: numbers from 1, as the tables give them."""
    try:
        return [int(number) - 1 for number in tour.split(",")]
    except ValueError:
        raise ConfigurationError(f"--tour {tour} is no list of pieces, as 1,2,1 is") from None


def _warn_of_ground(loaded: Any, scale: float) -> None:
    """Warns of waypoints in space that are not above the ground."""
    if loaded.dim == 3:
        lowest = scale * float(loaded.cloud.points[:, 2].min())
        if lowest <= 0:
            message = f"warning: the path goes down to z = {lowest:.4g} m; the ground is at 0"
            errors.print(message, style="bold red")


def _view(
    loaded: Any, scale: float, speed: float, html: bool, meshcat: bool, results: Path | None
) -> Any:
    """Returns how the flights are watched, with the tube of results, and tells where."""
    from sgvf_drake.experiments import View, tube_curves
    from systems import MakeMeshcat

    largest = scale * max(float(abs(bound).max()) for bound in loaded.cloud.box)
    if largest * SINGLE_PRECISION > SHARP:
        message = (
            f"warning: browsers resolve {largest * SINGLE_PRECISION:.2g} m at coordinates of "
            f"{largest:.2g} m; subtract an offset from the waypoints to see more"
        )
        errors.print(message, style="bold red", soft_wrap=True)
    curves = () if results is None else tube_curves(loaded, results, scale, speed)
    viewer = MakeMeshcat() if meshcat else None
    if viewer is not None:
        console.print(f"watch it at {viewer.web_url()}", highlight=False)
        console.print("its sliders change the flight, and Stop ends it")
        if console.is_terminal:
            console.input("press Enter to take off ...")
    return View(html, viewer, curves)


@app.command()
def demo(out: Out = Path("demo"), overwrite: Overwrite = False) -> None:
    """Train on the paper's concentric rings, follow them, and fly each of them."""
    from sgvf_drake.experiments import run_demo

    with progress() as report:
        summary = run_demo(out, overwrite=overwrite, progress=report)
    print_training(summary["train"])
    print_following(summary["follow"])
    print_flight(summary["fly"])
    print_folder(out)
