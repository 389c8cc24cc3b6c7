"""Files of waypoints."""

import pytest


@pytest.fixture
def write(tmp_path):
    """Writes a file of waypoints, and returns its path."""

    def write_file(content, name="waypoints.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_file
