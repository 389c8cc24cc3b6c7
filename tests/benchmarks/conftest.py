"""Where the measured tables go: the terminal and build/bench."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

OUT = Path("build/bench")


@pytest.fixture(scope="session")
def save() -> Callable[[pd.DataFrame, str], None]:
    """Prints a table and saves it as build/bench/NAME.csv."""

    def save_table(table: pd.DataFrame, name: str) -> None:
        OUT.mkdir(parents=True, exist_ok=True)
        table.to_csv(OUT / f"{name}.csv", index=False)
        print(f"\n{name}\n{table.round(4).to_string(index=False)}")

    return save_table
