"""How the tests of commands run them, and what each has to say to bad input."""

import re

import pytest

from sgvf_drake.cli import main


def run_command(*arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0


@pytest.fixture(scope="session")
def run():
    """Runs a command in this process; returns its exit status."""
    return run_command


@pytest.fixture
def refused(capsys):
    """Runs a command that has to end with status 2 and one line; returns the line."""

    def check(*arguments):
        capsys.readouterr()
        assert run_command(*arguments) == 2
        printed = capsys.readouterr()
        # At most what was read.
        assert re.fullmatch(r"(\w+\.csv: .*\n)*", printed.out)
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") == 1, printed.err
        return printed.err

    return check


@pytest.fixture(scope="session")
def trained(tmp_path_factory, flight_field):
    """The folder of a training, with the stored field of circles of 1 m and 2 m."""
    folder = tmp_path_factory.mktemp("trained")
    flight_field.save(folder / "field.safetensors")
    return folder
