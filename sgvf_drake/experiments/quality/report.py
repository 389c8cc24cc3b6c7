"""What is printed of a table: what failed, then the worst of each group of cases."""

import pandas as pd
from rich.console import Console
from rich.table import Table

from sgvf_drake.experiments.quality.case import LABELS


def print_summary(table: pd.DataFrame, console: Console) -> None:
    """Prints what failed, with its message, and then the table by groups of cases."""
    failed = table[table["failure"].notna()]
    headline = f"{len(failed)} of {len(table)} cases fall short"
    console.print(headline, style="bold red" if len(failed) else "bold green")
    for key, message in zip(failed["key"], failed["failure"], strict=True):
        # Not as markup: a message may hold brackets.
        console.print(f"  {key}: {message}", markup=False, highlight=False, soft_wrap=True)
    if table["code"].nunique() > 1:
        console.print("these are results of several versions of the code", style="bold red")
    columns = {
        "lap": ("lap", "min", ".1%"),
        "end": ("end", "min", ".1%"),
        "RMS": ("rms_u", "max", ".4f"),
        "max": ("max_u", "max", ".3f"),
        "cosine": ("score_cosine", "min", ".3f"),
        "bias": ("score_bias_u", "max", ".4f"),
        "CPU s": ("train_cpu_s", "median", ".1f"),
    }
    # Without lines, so that it fits in 80 columns.
    title = "The worst of each cloud, lengths in U, and the median time"
    printed = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    printed.add_column("cloud")
    for heading in ("recipe", "good", *columns):
        printed.add_column(heading, justify="right", no_wrap=True)
    for labels, group in table.groupby(list(LABELS[:-1]), sort=False):
        _, shape, sampling, recipe = map(str, labels)
        good = f"{int(group['failure'].isna().sum())}/{len(group)}"
        values = [_format(group[name].agg(how), to) for name, how, to in columns.values()]
        printed.add_row(f"{shape} {sampling}", recipe, good, *values)
    console.print(printed)


def _format(value: float, form: str) -> str:
    return "-" if pd.isna(value) else format(value, form)
