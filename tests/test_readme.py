"""The README does what it says: its Python runs as written, its commands parse."""

from dataclasses import replace
from pathlib import Path
import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
import typer

from sgvf_drake import cli, learning, load_field, make_shape
from tests.fields import exact_field
from tests.helpers import circle

ROOT = Path(__file__).parents[1]
COMMANDS = {
    *("paths", "train", "import", "follow", "fly", "montecarlo", "verify", "certify"),
    *("singularities", "export", "demo", "run", "reproduce"),
}
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)


def command_lines(program):
    lines = [line.split("#")[0].strip() for text in blocks("sh") for line in text.splitlines()]
    return [line for line in lines if line.split()[:1] == [program]]


def own_lines(code):
    """Lines that are neither blank nor a comment."""
    return [line for line in code.splitlines() if line.strip() and line.strip()[0] != "#"]


@pytest.fixture(scope="module", params=[False, pytest.param(True, marks=pytest.mark.full)])
def executed(request, tmp_path_factory):
    """The namespaces of the Python blocks, run one after the other in one fresh folder.

    The training is one in earnest, or what it would make of a circle is known in closed form.
    """
    folder = tmp_path_factory.mktemp("readme")
    ring = exact_field(circle(1.0, 80), sigma=0.4, gain=0.8)
    points = make_shape("concentric-flight")[0].points if request.param else ring.cloud.points
    np.savetxt(folder / "waypoints.csv", points, delimiter=",", header="x,y", comments="")

    def stand_in(cloud, config):
        np.testing.assert_allclose(cloud.points, ring.cloud.points)
        assert config == learning.TrainingConfig(seed=0)
        field = replace(ring, cloud=cloud)
        return SimpleNamespace(field=field, self_check=learning.check_field(field))

    namespaces = []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        if not request.param:
            patch.setattr(learning, "train", stand_in)
        for number, code in enumerate(blocks("python")):
            namespace = {"__name__": f"readme_{number}"}
            if number == 1:
                # It goes on where the first block ended.
                namespace |= namespaces[0]
            exec(compile(code, f"README.md, block {number}", "exec"), namespace)
            namespaces.append(namespace)
    return folder, namespaces


def test_the_first_lines_train_and_save(executed):
    folder, (first, *_) = executed
    assert first["result"].self_check.passed
    stored = load_field(folder / "field.safetensors")
    points = first["cloud"].points
    np.testing.assert_array_equal(stored(points), first["field"](points))
    np.testing.assert_allclose(np.linalg.norm(stored(points), axis=1), 1.0, atol=0.05)
    assert len(own_lines(blocks("python")[0])) <= 10


def test_the_second_lines_verify(executed):
    _, (_, second, _) = executed
    assert second["found"].holds, second["found"].reason


def test_guidance_in_a_diagram_of_ones_own_flies_the_circle(executed):
    _, (*_, second) = executed
    assert len(own_lines(blocks("python")[-1])) < 15
    context = second["simulator"].get_context()
    assert context.get_time() == 30.0
    x, y, z = context.get_continuous_state_vector().CopyToVector()[:3]
    assert np.hypot(x, y) == pytest.approx(1.0, abs=0.02)
    assert z == pytest.approx(1.0, abs=0.01)


def parse(line):
    """Parses a command line as the program does, up to the call of the command."""
    group = typer.main.get_command(cli.app)
    _, *arguments = shlex.split(line)
    with group.make_context("sgvf", list(arguments)) as context:
        name, command, rest = group.resolve_command(context, arguments)
        return name, command.make_context(name, rest, parent=context).params


def test_commands_parse_and_every_one_is_shown():
    parsed = [parse(line) for line in command_lines("sgvf")]
    assert {name for name, _ in parsed} == COMMANDS
    assert all(parameters["out"] is not None for _, parameters in parsed)


def test_a_command_that_is_wrong_does_not_parse(capsys):
    with pytest.raises(Exception, match=r"(?i)no such option"):
        parse("sgvf fly results/train --spede 1 --out x")


def test_make_targets_and_variables_exist():
    makefile = (ROOT / "Makefile").read_text()
    targets = [line.split()[1] for line in command_lines("make")]
    assert targets == ["demo", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE)
    variables = set(re.findall(r"([A-Z]+)=", TEXT))
    assert variables == {"PYTHON", "VERSIONS"}
    for variable in variables:
        assert re.search(rf"^{variable} \?=", makefile, flags=re.MULTILINE)


def test_files_and_folders_are_those_of_the_project():
    for folder in re.findall(r"`((?:sgvf_drake/|systems|notebooks|tests)[\w/]*)`", TEXT):
        assert (ROOT / folder).is_dir(), folder
    links = re.findall(r"[^!]\[[^]]*\]\(([^)#:]+)\)", TEXT)
    assert "notebooks/00_quickstart.ipynb" in links
    for link in links:
        assert (ROOT / link).is_file(), link


def test_results_are_named_as_they_are_written():
    from sgvf_drake.experiments.importing import IMPORT_FILES
    from sgvf_drake.experiments.runs import FOLLOW_FILES, TOUR_FILES, TRAIN_FILES
    from sgvf_drake.experiments.singularities import SINGULARITIES_FILES
    from sgvf_drake.experiments.verify import VERIFY_FILES
    from sgvf_drake.export import C_FILES
    from sgvf_drake.paper.reproduce import REPORT
    from sgvf_drake.paper.scenario import SCENARIO_FILE, TRIALS

    written = (
        *(*TRAIN_FILES, *FOLLOW_FILES, *TOUR_FILES),
        *(*IMPORT_FILES, *VERIFY_FILES, *SINGULARITIES_FILES),
        *(*C_FILES, REPORT, SCENARIO_FILE, TRIALS),
    )
    for name in (*written, "flight_N.parquet", "waypoints.csv"):
        assert f"`{name}`" in TEXT, name
