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
from sgvf_drake.paper.experiment import load_rows
from sgvf_drake.paper.report import view_table
from sgvf_drake.paper.scenario import Scenario, load_scenario, scenario_names

INTRODUCTION = """\
# What the experiments found

This page is made from the rows of a full run of `sgvf reproduce`
(`python -m sgvf_drake.paper.findings docs/results`), and a test holds it to them. Intervals
are 95 % over the seeds; U is an eighth of the path's extent. A verdict follows by a rule in
code from the figures that stand with the claim in the section of its experiment.

The rows are older than the network of paths: fields were trained along a spanning tree. Newer,
in the comparison with classical fields, are the rows of the figure-eight, the race course, the
demonstrations, the streets and the knot, of directed SGVF, and of all that is sorted first.
Their times do not compare with older ones. On those five clouds SGVF of the position alone has
one seed, as have some classical fields that depend on chance.
"""

PICTURES = {
    "fig4_ablation": (
        "The tangent field complete and without each loss, by the shallow and the deep "
        "network: triangles where it turns around",
        "ablation.png",
    ),
    "fig6_corners": (
        "Where agents stall: a square and a hexagon by the shallow network, a hexagon by the "
        "deep one, a square by the robust recipe",
        "corners.png",
    ),
}
COUNTED = {Verdict.HOLDS: "hold", Verdict.PARTLY: "hold in part", Verdict.FAILS: "do not"}


def findings_page(folder: Path) -> str:
    """Returns the page, in Markdown, of the scenarios whose rows are in a folder.

    Args:
        folder: A file `SCENARIO.json` for each, as `experiment.save_rows` writes them.
    """
    rows = {
        name: load_rows(file)
        for name in scenario_names()
        if (file := folder / f"{name}.json").is_file()
    }
    scenarios = {name: load_scenario(name) for name in rows}
    found = {name: one.experiment.findings(rows[name]) for name, one in scenarios.items()}
    findings = [one for judged in found.values() for one in judged]
    parts = [
        INTRODUCTION,
        _overview("The paper's claims", [one for one in findings if one.of_paper]),
        _overview("Ours, by the same rules", [one for one in findings if not one.of_paper]),
        *(_section(name, one, rows[name], found[name]) for name, one in scenarios.items()),
    ]
    return "\n".join(parts)


def _overview(title: str, findings: list[Finding]) -> str:
    counts = Counter(finding.verdict for finding in findings)
    told = ", ".join(f"{counts[verdict]} {word}" for verdict, word in COUNTED.items())
    rows = [(_claim(one), one.source, str(one.verdict)) for one in findings]
    table = _markdown(["claim", "place", "verdict"], rows)
    return f"## {title}\n\nOf {len(findings)}, {told}.\n\n{table}\n"


def _section(name: str, scenario: Scenario, rows: Rows, findings: list[Finding]) -> str:
    judged = [f"- **{_claim(one)}: {one.verdict}.** {one.evidence}" for one in findings]
    parts = [f"## {scenario.title} ({scenario.source})\n", "\n".join(judged) + "\n"]
    for exhibit in scenario.experiment.tables(rows):
        assert isinstance(exhibit.content, pd.DataFrame)
        shown = view_table(exhibit.content)
        columns = [column for column, _ in shown.columns]
        parts.append(f"{exhibit.caption}\n\n{_markdown(columns, shown.rows)}\n")
    if name in PICTURES:
        caption, file = PICTURES[name]
        parts.append(f"![{caption}](images/{file})\n")
    return "\n".join(parts)


def _claim(finding: Finding) -> str:
    return finding.statement.rstrip(".")


def _markdown(columns: list[str], rows: Any) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines
    )


if __name__ == "__main__":
    sys.stdout.write(findings_page(Path(sys.argv[1])))
