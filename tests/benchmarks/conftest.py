"""Where the measured tables of `make bench` go: the terminal and build/bench."""

from pathlib import Path

import pandas as pd
import pytest


@pytest.fixture(scope="session")
def out():
    """The folder of tables and figures."""
    folder = Path("build/bench")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def save(out):
    """Prints rows as a table and saves it in build/bench, as CSV and JSON: (rows, name)."""

    def save_table(rows, name):
        table = pd.DataFrame(rows)
        table.to_csv(out / f"{name}.csv", index=False)
        table.to_json(out / f"{name}.json", orient="records", indent=1)
        print(f"\n{name}\n{table.round(4).to_string(index=False)}")
        return table

    return save_table
