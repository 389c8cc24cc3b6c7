"""Runs the Python of the README and some of its commands with the installed wheel.

`make wheel` calls it in an empty environment.  The README is the one in the metadata of the
wheel, and the folder is a new one, so that nothing comes from the repository.
"""

from importlib.metadata import metadata
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
import tempfile
import time

import numpy as np

import sgvf_drake
import systems

# One line of the README each: what needs no file but the waypoints, and a minute at most.
COMMANDS = (
    "sgvf paths waypoints.csv",
    "sgvf train --points waypoints.csv",
    "sgvf follow results/train",
    "sgvf fly results/train --speed",
    "sgvf verify results/train",
    "sgvf certify results/train",
    "sgvf singularities results/train",
    "sgvf demo",
)
BIN = Path(sys.executable).parent


def blocks(readme: str, language: str) -> list[str]:
    """Returns the code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", readme, flags=re.MULTILINE | re.DOTALL)


def chosen_lines(readme: str) -> list[str]:
    """Returns the lines of the README that begin as COMMANDS do, of each kind one."""
    lines = "".join(blocks(readme, "sh")).splitlines()
    found = [[line for line in lines if line.startswith(start)] for start in COMMANDS]
    assert all(len(each) == 1 for each in found), found
    return [line for (line,) in found]


def main() -> None:
    """Runs all of it, and tells what each part took."""
    for package in (sgvf_drake, systems):
        place = Path(package.__file__ or "")
        assert place.is_relative_to(sys.prefix), f"{place} is not of this environment"
    readme = metadata("sgvf-drake").get_payload()
    with tempfile.TemporaryDirectory() as folder:
        cloud, _ = sgvf_drake.make_shape("concentric-flight")
        np.savetxt(f"{folder}/waypoints.csv", cloud.points, delimiter=",", header="x,y")
        Path(folder, "program.py").write_text("".join(blocks(readme, "python")))
        environment = {**os.environ, "MPLBACKEND": "Agg"}
        environment.pop("PYTHONPATH", None)
        for line in ("python program.py", *chosen_lines(readme)):
            program, *arguments = shlex.split(line)
            start = time.monotonic()
            subprocess.run([BIN / program, *arguments], cwd=folder, env=environment, check=True)
            print(f"-- {line}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
