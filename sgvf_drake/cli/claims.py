"""What the commands print of experiments: verdicts, files, and how it stands with each."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from sgvf_drake.cli.application import console, errors

STYLES = {"holds": "green", "holds in part": "yellow", "does not hold": "red"}


def print_claims(claims: Sequence[Mapping[str, Any]]) -> None:
    """Prints a row for each claim: the verdict, what is said, and the evidence."""
    if not claims:
        return
    table = Table(title="Claims", title_justify="left", show_lines=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("claim", ratio=1)
    table.add_column("evidence", ratio=1)
    for claim in claims:
        # As text: brackets would be markup.
        table.add_row(
            Text(claim["verdict"], style=STYLES[claim["verdict"]]),
            Text(f"{claim['statement']} ({claim['source']})"),
            Text(claim["evidence"]),
        )
    console.print(table)


def print_exhibits(summary: Mapping[str, Any]) -> None:
    """Prints the files of a result: figures and tables, with what they show."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    for exhibit in summary["exhibits"]:
        table.add_row(Text(exhibit["file"]), Text(exhibit["caption"], style="dim"))
    console.print(table)


def print_scenarios(scenarios: Mapping[str, tuple[str, str, Sequence[str]]]) -> None:
    """Prints the scenarios by name: title, source, and overrides."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for heading in ("name", "shows", "in the paper", "overrides"):
        table.add_column(heading, no_wrap=heading == "name")
    for name, (title, source, overrides) in scenarios.items():
        table.add_row(*map(Text, (name, title, source, ", ".join(overrides))))
    console.print(table)


def print_reproduction(summary: Mapping[str, Any]) -> None:
    """Prints how it stands with each scenario, with the errors of those that failed."""
    table = Table(title="Reproduction", title_justify="left")
    table.add_column("scenario", no_wrap=True)
    for heading in ("", *STYLES, "trials, s"):
        table.add_column(Text(heading, justify="right"), justify="right")
    for name, entry in summary["scenarios"].items():
        claims = [claim for claim in summary["claims"] if claim["scenario"] == name]
        seconds = entry["trial_s"]
        table.add_row(
            name,
            Text(entry["status"], style="red" if entry["status"] == "failed" else ""),
            *_counts(claims),
            "" if seconds is None else f"{seconds:.1f}",
        )
    console.print(table)
    for name, entry in summary["scenarios"].items():
        if entry["status"] == "failed":
            text = f"{name} failed: {entry['error']}"
            # Not as markup: a message may hold brackets.
            errors.print(text, markup=False, style="bold red", soft_wrap=True)


def _counts(claims: Sequence[Mapping[str, Any]]) -> list[str]:
    """How many claims have each verdict; nothing where there are none."""
    counts = Counter(claim["verdict"] for claim in claims)
    return [str(counts[verdict] or "") for verdict in STYLES]
