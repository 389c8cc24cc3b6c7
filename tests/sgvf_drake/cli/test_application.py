"""The program as a whole: how it is started, helps, refuses, and keeps what is there."""

from pathlib import Path
import subprocess
import sys

import pytest

from sgvf_drake import __version__, cli
from tests.helpers import content_of, names_in

FOLLOW_FILES = {"summary.json", "trajectories.parquet", "follow.png"}


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        ("train --shape circle", "losses.csv"),
        ("follow .", "follow.png"),
        ("fly .", "flight_1.html"),
        ("fly . --tour 1", "tour.html"),
        ("verify .", "theorem.png"),
        ("certify .", "certificate.json"),
        ("singularities .", "zeros.csv"),
        ("demo", "waypoints.csv"),
        ("run baselines", "summary.json"),
        ("reproduce", "report.html"),
    ],
)
def test_existing_results_stay(refused, trained, tmp_path, monkeypatch, command, kept):
    monkeypatch.chdir(trained)
    (tmp_path / kept).write_text("mine")
    line = refused(*command.split(), "--out", tmp_path)
    assert f"already holds {kept}" in line
    assert "--overwrite" in line
    assert content_of(tmp_path) == {tmp_path / kept: b"mine"}


def test_a_file_as_folder(refused, trained, tmp_path):
    (tmp_path / "file").write_text("mine")
    for out in ("file", "file/inner"):
        line = refused("follow", trained, "--out", tmp_path / out)
        assert f"cannot write to {tmp_path / out}" in line
        assert "not a folder" in line
        assert content_of(tmp_path) == {tmp_path / "file": b"mine"}


def test_usage_errors(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for arguments, culprit in (
        ("train --shape circle --recipe best --out out", "best"),
        ("train --shape circle --seed half --out x", "--seed"),
        ("train --shape circle", "--out"),
        ("follow --out out", "FIELD"),
        ("fly field --spede 1 --out out", "--spede"),
        ("fly field --sensors --seed -1 --out out", "--seed"),
        ("fly field --gust -1 --out out", "--gust"),
        ("flly", "flly"),
    ):
        assert run(*arguments.split()) == 2
        shown = capsys.readouterr()
        assert culprit in shown.err
        assert "Traceback" not in shown.err
    assert names_in(tmp_path) == set()


def test_the_help_shows_the_defaults_and_the_commands_in_their_order(run, capsys):
    # Brackets are markup to Rich, which would swallow them.
    for command, default in (("train", "[default: 200]"), ("follow", "laps + 15 U]")):
        assert run(command, "--help") == 0
        words = capsys.readouterr().out.replace("│", " ").split()
        assert default in " ".join(words)
    assert run("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    listed = [line.split()[1] for line in lines if line.startswith("│ ")]
    assert listed.index("train") < listed.index("import") < listed.index("follow")


# As users start it.


def run_process(*arguments, **options):
    return subprocess.run(arguments, capture_output=True, text=True, **options)


def test_the_program_reports_bad_input(tmp_path):
    program = Path(sys.executable).with_name("sgvf")
    done = run_process(program, "train", "--points", "none.csv", "--out", "x", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: none.csv: there is no such file\n"
    assert names_in(tmp_path) == set()
    done = run_process(sys.executable, "-m", "sgvf_drake", "--version", cwd=tmp_path)
    assert done.stdout == f"sgvf_drake {__version__}\n"


def test_another_package_named_systems_is_told_in_one_line(trained, tmp_path):
    other = tmp_path / "systems" / "__init__.py"
    other.parent.mkdir()
    other.write_text("")
    command = ("follow", str(trained), "--starts", "1", "--duration", "1", "--out", "out")
    done = run_process(sys.executable, "-m", "sgvf_drake", *command, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: cannot import name ")
    assert f"from 'systems' ({other})" in line
    assert names_in(tmp_path) == {"systems"}


def test_an_import_that_fails_elsewhere_is_no_such_case(monkeypatch):
    def broken(arguments):
        raise ImportError("no drake", name="pydrake.systems")

    monkeypatch.setattr("sgvf_drake.cli.application.app", broken)
    with pytest.raises(ImportError, match="no drake"):
        cli.main(["shapes"])


def modules_after(arguments, folder):
    """Runs a command in a fresh process: its exit status, and the modules it imported."""
    code = (
        "import sys\n"
        "from sgvf_drake.cli import main\n"
        "try:\n"
        "    main(sys.argv[1:])\n"
        "except SystemExit as end:\n"
        "    print(end.code or 0, *sys.modules, file=sys.stderr)\n"
    )
    done = run_process(sys.executable, "-c", code, *arguments, cwd=folder, check=True)
    status, *modules = done.stderr.splitlines()[-1].split()
    return int(status), set(modules), done.stdout


@pytest.mark.parametrize(
    ("option", "shown"), [("--version", __version__), ("--help", "Usage:")]
)
def test_version_and_help_import_little(option, shown, tmp_path):
    status, modules, out = modules_after([option], tmp_path)
    assert status == 0
    assert shown in out
    assert not modules & {"torch", "pydrake", "matplotlib", "systems"}


def test_follow_does_without_torch(trained, tmp_path):
    command = ["follow", str(trained), "--starts", "1", "--duration", "1", "--out", "out"]
    status, modules, _ = modules_after(command, tmp_path)
    assert status == 0
    assert "pydrake" in modules
    assert "torch" not in modules
    assert names_in(tmp_path / "out") == FOLLOW_FILES
