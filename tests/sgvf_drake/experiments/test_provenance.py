"""Where results come from: the versions, and the commit of the checkout."""

from importlib.metadata import version
import platform
import re
import subprocess

import pytest

import sgvf_drake
from sgvf_drake.experiments import provenance


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A package in a repository of one commit; where the package is."""
    package = tmp_path / "project" / "ours"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    git = [
        "git",
        "-c",
        "user.name=a",
        "-c",
        "user.email=a@b.invalid",
        "-C",
        str(package.parent),
    ]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *arguments], check=True)
    monkeypatch.setattr(sgvf_drake, "__file__", str(package / "__init__.py"))
    head = subprocess.run(
        [*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True
    ).stdout
    return package, head.strip()


def test_versions_are_those_that_run():
    versions = provenance.provenance()["versions"]
    assert versions["sgvf_drake"] == sgvf_drake.__version__
    assert versions["python"] == platform.python_version()
    for name in ("drake", "torch", "numpy"):
        assert versions[name] == version(name)


def test_the_commit_is_that_of_the_checkout(checkout):
    _, head = checkout
    found = provenance._commit()
    assert re.fullmatch(r"[0-9a-f]{12}", found)
    assert head.startswith(found)


def test_changed_files_are_told(checkout):
    package, head = checkout
    (package / "__init__.py").write_text("changed = True\n")
    assert provenance._commit() == f"{head[:12]}-dirty"


def test_a_package_in_another_project_has_no_commit(checkout, monkeypatch):
    package, _ = checkout
    deeper = package / "site-packages" / "ours" / "__init__.py"
    deeper.parent.mkdir(parents=True)
    monkeypatch.setattr(sgvf_drake, "__file__", str(deeper))
    assert provenance._commit() is None


def test_there_is_no_commit_without_a_repository_or_git(tmp_path, monkeypatch):
    monkeypatch.setattr(sgvf_drake, "__file__", str(tmp_path / "ours" / "__init__.py"))
    assert provenance._commit() is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance._commit() is None
