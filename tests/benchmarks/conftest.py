"""Where the measured tables go: the terminal and build/bench."""

from pathlib import Path

import pytest

OUT = Path("build/bench")


@pytest.fixture(scope="session")
def save():
    """Prints a table and saves it as build/bench/NAME.csv: (table, name)."""

    def save_table(table, name):
        OUT.mkdir(parents=True, exist_ok=True)
        table.to_csv(OUT / f"{name}.csv", index=False)
        print(f"\n{name}\n{table.round(4).to_string(index=False)}")

    return save_table
