"""What is published: the sdist, the wheel that is built of it, and what describes them.

`make wheel` also installs the wheel in an empty environment and runs the README there.
"""

from email import message_from_string
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from zipfile import ZipFile

import pytest
import yaml

import sgvf_drake
from tests.distribution import quickstart

ROOT = Path(__file__).parents[2]
PACKAGES = ("sgvf_drake", "systems")
# What the build reads; nothing else of the project is there when it runs.
SOURCES = (*PACKAGES, "tests")
DESCRIPTIONS = (
    *("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md"),
    "CITATION.cff",
)
KEEP_A_CHANGELOG = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def built(kind, source, out):
    """Has setuptools build, as `python -m build` would have it; the file."""
    code = f"from setuptools import build_meta; print(build_meta.build_{kind}({str(out)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=True
    )
    return out / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """The files of the packages; names in the sdist; names in the wheel and its metadata."""
    folder = tmp_path_factory.mktemp("distribution")
    project = folder / "project"
    for name in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, project / name, ignore=ignored)
    for name in DESCRIPTIONS:
        shutil.copy(ROOT / name, project)
    files = {
        file.relative_to(project).as_posix()
        for package in PACKAGES
        for file in (project / package).rglob("*")
        if file.is_file()
    }
    with tarfile.open(built("sdist", project, folder)) as sdist:
        sdist.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    in_sdist = {
        file.relative_to(unpacked).as_posix() for file in unpacked.rglob("*") if file.is_file()
    }
    with ZipFile(built("wheel", unpacked, folder)) as wheel:
        in_wheel = set(wheel.namelist())
        (place,) = (name for name in in_wheel if name.endswith(".dist-info/METADATA"))
        told = message_from_string(wheel.read(place).decode())
    return files, in_sdist, in_wheel, told


@pytest.mark.full
def test_the_wheel_has_every_file_of_the_packages_and_no_other(distributions):
    files, _, in_wheel, _ = distributions
    assert {f"{package}/py.typed" for package in PACKAGES} < files
    assert {Path(file).suffix for file in files} > {".py", ".yaml", ".html", ".css"}
    assert {name for name in in_wheel if ".dist-info/" not in name} == files
    info = f"sgvf_drake-{sgvf_drake.__version__}.dist-info"
    assert f"{info}/licenses/LICENSE" in in_wheel


@pytest.mark.full
def test_the_sdist_has_what_the_wheel_is_built_of_and_no_tests(distributions):
    files, in_sdist, _, _ = distributions
    others = {name for name in in_sdist - files if ".egg-info/" not in name}
    assert files < in_sdist
    assert others == {*DESCRIPTIONS, "PKG-INFO", "setup.cfg"}


@pytest.mark.full
def test_the_metadata_say_what_the_project_says(distributions):
    *_, told = distributions
    assert told["Version"] == sgvf_drake.__version__
    assert told["License-Expression"] == "BSD-3-Clause"
    assert told["Requires-Python"] == ">=3.11"
    assert told["Description-Content-Type"] == "text/markdown"
    assert told.get_payload().strip() == (ROOT / "README.md").read_text("utf-8").strip()
    extras = told.get_all("Provides-Extra")
    assert set(extras) == set(SETTINGS["project"]["optional-dependencies"])


def test_the_commands_that_are_tried_are_lines_of_the_readme():
    lines = quickstart.chosen_lines((ROOT / "README.md").read_text(encoding="utf-8"))
    assert [line.split(" --out ")[0] for line in lines][-1] == "sgvf demo"
    with pytest.raises(AssertionError):
        quickstart.chosen_lines("```sh\nsgvf demo --out demo\n```\n")


def test_the_version_stands_in_one_place():
    assert "version" in SETTINGS["project"]["dynamic"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert "version" not in citation


def test_the_citation_agrees_with_the_package():
    project = SETTINGS["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["title"].replace("_", "-") == project["name"]
    assert citation["license"] == project["license"]
    assert citation["keywords"] == project["keywords"]
    assert [each["name"] for each in citation["authors"]] == [
        author["name"] for author in project["authors"]
    ]
    (paper,) = citation["references"]
    assert paper["url"] == project["urls"]["Paper"]


def headings(changelog, level):
    return re.findall(rf"^{'#' * level} (.*)$", changelog, flags=re.MULTILINE)


def test_the_changelog_keeps_its_form():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *released = headings(text, 2)
    assert first == "Unreleased"
    matches = [
        re.fullmatch(r"(\d+\.\d+\.\d+) - (\d{4}-\d{2}-\d{2})", name) for name in released
    ]
    assert all(matches), released
    versions = [tuple(map(int, match[1].split("."))) for match in matches]
    assert versions == sorted(versions, reverse=True)
    dates = [match[2] for match in matches]
    assert dates == sorted(dates, reverse=True)
    assert set(headings(text, 3)) <= KEEP_A_CHANGELOG
    # A version that is no development version is one that has its heading.
    current = sgvf_drake.__version__
    assert ".dev" in current or current == released[0].split(" ")[0]
