"""The commands that make a field: train, from a file or one of the shapes, and import."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sgvf_drake.cli.application import app, console, progress
from sgvf_drake.cli.options import (
    Columns,
    Out,
    Overwrite,
    columns_of,
    directions_of,
    pair_of,
    point_of,
)
from sgvf_drake.cli.tables import print_folder, print_import, print_messages, print_training
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import PAPER_GAIN
from sgvf_drake.learning.recipes import RECIPES

Sampling = Literal["uniform", "random"]


@app.command()
def train(
    out: Out,
    points: Annotated[
        Path | None,
        typer.Option(help="Waypoints in any order: CSV, text, .npy, GPX or a mission."),
    ] = None,
    shape: Annotated[
        str | None, typer.Option(help="A named shape in place of a file; see `sgvf shapes`.")
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(help="A network.json of `sgvf paths`, whose lines are the waypoints."),
    ] = None,
    columns: Columns = None,
    num_points: Annotated[
        int | None, typer.Option(help="Waypoints of the shape  \\[default: 200].")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="Noise of the shape's waypoints, std  \\[default: 0].")
    ] = None,
    sampling: Annotated[
        Sampling | None, typer.Option(help="Sampling of the shape  \\[default: uniform].")
    ] = None,
    recipe: Annotated[
        str, typer.Option(help="How to learn.", metavar=f"[{'|'.join(RECIPES)}]")
    ] = "robust",
    seed: Annotated[int, typer.Option(help="Of every random number of the run.")] = 0,
    is_open: Annotated[
        bool | None,
        typer.Option(
            "--open/--closed",
            help="All pieces are open paths, with ends, or closed  \\[default: as they look].",
        ),
    ] = None,
    passes: Annotated[
        bool, typer.Option("--passes", help="All waypoints are passes of one path.")
    ] = False,
    direction: Annotated[
        str | None,
        typer.Option(
            help="Direction of travel: ccw, cw or reverse; or one for each piece, the longest "
            "first, as in cw,-,reverse; - is the rule  \\[default: as recorded; else closed "
            "pieces ccw, open ones from the smaller x].",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y", help="A point near which open paths start, in the waypoints' unit."
        ),
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option(
            "--anyway",
            help="No direction asked, though paths branch or cross.",
        ),
    ] = False,
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
    from sgvf_drake.clouds import PointCloud
    from sgvf_drake.paths import PathNetwork, make_shape

    if sum(given is not None for given in (points, shape, network)) != 1:
        raise ConfigurationError(
            "give one of --points FILE, --shape NAME and --network network.json"
        )
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
        "passes": passes or None,
        "direction": directions_of(direction),
        "start": point_of(start),
    }
    _check_recipe(recipe, of_path, score_iterations)
    chosen = columns_of(columns, points, "--points")
    if given and shape is None:
        option = f"--{next(iter(given))}".replace("_", "-")
        raise ConfigurationError(f"{option} is for --shape; a file is taken as it is")
    source: PointCloud | PathNetwork
    if points is not None:
        source = PointCloud.read(points, chosen)
        print_messages(source.messages)
    elif network is not None:
        source = PathNetwork.load(network)
    else:
        assert shape is not None
        source, _ = make_shape(shape, seed=seed, **given)
    # Slow to import, so only once the waypoints are read.
    from sgvf_drake.experiments import run_train
    from sgvf_drake.learning import TrainingConfig

    asked = {name: value for name, value in of_path.items() if value is not None}
    config = TrainingConfig(recipe=recipe, seed=seed, anyway=anyway, **asked, **overrides)
    with progress() as report:
        summary = run_train(source, config, out, overwrite=overwrite, progress=report)
    said = source.messages if points is not None else ()
    print_messages(summary["messages"][len(said) :])
    print_training(summary)
    print_folder(out)


@app.command()
def shapes() -> None:
    """List the named shapes."""
    from sgvf_drake.paths import SHAPES

    console.print("\n".join(SHAPES))


@app.command("import")
def import_(
    score: Annotated[
        Path, typer.Option(help="Score network of (x, t): a checkpoint saved by torch.")
    ],
    tangent: Annotated[
        Path, typer.Option(help="Tangent network of x: a checkpoint saved by torch.")
    ],
    out: Out,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Waypoints of the training, in a file  \\[default: as the score shows them].",
        ),
    ] = None,
    columns: Columns = None,
    activation: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="What follows the hidden layers, as torch calls it: of both, or of the score "
            "and of the tangent  \\[default: what the files tell].",
        ),
    ] = None,
    key: Annotated[
        str | None,
        typer.Option(
            metavar="KEY[,KEY]",
            help="Entry of the checkpoints that is the state dict: of both, or of the score "
            "and of the tangent  \\[default: the only one].",
        ),
    ] = None,
    gain: Annotated[
        float, typer.Option("--k-s", "--gain", help="k_s of the normalised score.")
    ] = PAPER_GAIN,
    normalise: Annotated[
        bool, typer.Option("--normalise", help="Bring the field to length one.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Make a field of networks that were trained elsewhere."""
    chosen = columns_of(columns, points, "--points")
    # Slow to import, so only once the options are read.
    from sgvf_drake.experiments.importing import run_import

    summary = run_import(
        score,
        tangent,
        out,
        points=points,
        columns=chosen,
        activations=pair_of(activation, "--activation"),
        keys=pair_of(key, "--key"),
        gain=gain,
        normalise=normalise,
        overwrite=overwrite,
    )
    print_messages(summary["messages"])
    print_import(summary)
    print_folder(out)


def _check_recipe(
    recipe: str, of_path: Mapping[str, Any], score_iterations: int | None
) -> None:
    """Refuses options that the recipe would ignore."""
    if recipe not in RECIPES:
        raise ConfigurationError(
            f"--recipe cannot be {recipe!r}; it is one of {', '.join(RECIPES)}"
        )
    if not RECIPES[recipe].uses_paths:
        for name, value in of_path.items():
            if value is not None:
                option = "--closed" if value is False else f"--{name}"
                raise ConfigurationError(
                    f"{option} is not for the recipe {recipe}, which knows no pieces"
                )
    if not RECIPES[recipe].learns_score and score_iterations is not None:
        raise ConfigurationError(
            f"--score-iterations is not for the recipe {recipe}, which has no score network"
        )
