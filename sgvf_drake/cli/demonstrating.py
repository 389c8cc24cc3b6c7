"""The command that does the whole job once: demo."""

from pathlib import Path

from sgvf_drake.cli.application import app, progress
from sgvf_drake.cli.options import Out, Overwrite
from sgvf_drake.cli.tables import print_flight, print_folder, print_following, print_training


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
