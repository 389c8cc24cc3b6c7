"""The page of findings: every claim with its verdict, and every table, from stored rows.

A run of a scenario stores the rows of its trials beside its exhibits.  They are small, and
tables and claims follow from them alone, so that the rows of a full reproduction are kept in
the project, and its page of findings is made from them.

    python -m sgvf_drake.paper.findings docs/results > docs/findings.md
"""

from collections import Counter
from pathlib import Path
import sys
from typing import Any

import pandas as pd

from sgvf_drake.paper.claims import Finding, Rows, Verdict
from sgvf_drake.paper.experiment import Exhibit, load_rows
from sgvf_drake.paper.report.tables import view_table
from sgvf_drake.paper.scenario import Scenario, load_scenario, scenario_names

INTRODUCTION = """\
# What the experiments found

This page is made from the rows of a full run of `sgvf reproduce`
(`python -m sgvf_drake.paper.findings docs/results`). Intervals are 95 % over the seeds; U is an
eighth of the path's extent. Verdicts follow by a rule in code from the figures beside them.
"""


def findings_page(folder: Path) -> str:
    """Returns the page, in Markdown, of the scenarios whose rows are in a folder.

    Args:
        folder: A file `SCENARIO.json` for each, as `experiment.save_rows` writes them.
    """
    found = {
        name: (scenario, load_rows(file))
        for name in scenario_names()
        if (file := folder / f"{name}.json").is_file()
        for scenario in [load_scenario(name)]
    }
    findings = [
        finding
        for scenario, rows in found.values()
        for finding in scenario.experiment.findings(rows)
    ]
    ours = [one for one in findings if not one.of_paper]
    parts = [
        INTRODUCTION,
        _claims("The paper's claims", [one for one in findings if one.of_paper]),
        _claims("Ours, by the same rules", ours),
        *(_section(scenario, rows) for scenario, rows in found.values()),
    ]
    return "\n".join(parts)


def _claims(title: str, findings: list[Finding]) -> str:
    counts = Counter(finding.verdict for finding in findings)
    told = ", ".join(f"{counts[verdict]} {verdict}" for verdict in Verdict)
    rows = [
        (one.statement.rstrip("."), one.source, str(one.verdict), one.evidence.rstrip("."))
        for one in findings
    ]
    table = _markdown(["claim", "place", "verdict", "measured"], rows)
    return f"## {title}\n\nOf {len(findings)}: {told}.\n\n{table}\n"


def _section(scenario: Scenario, rows: Rows) -> str:
    tables: list[Exhibit] = scenario.experiment.tables(rows)
    parts = [f"## {scenario.title} ({scenario.source})\n"]
    for exhibit in tables:
        assert isinstance(exhibit.content, pd.DataFrame)
        shown = view_table(exhibit.content)
        names = [name for name, _ in shown.columns]
        parts.append(f"{exhibit.caption}\n\n{_markdown(names, shown.rows)}\n")
    return "\n".join(parts)


def _markdown(columns: list[str], rows: Any) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines
    )


if __name__ == "__main__":
    sys.stdout.write(findings_page(Path(sys.argv[1])))
