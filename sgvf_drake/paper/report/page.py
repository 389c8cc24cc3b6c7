"""The page itself: one HTML file that needs no other, and no script."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.report.pictures import embed
from sgvf_drake.paper.report.tables import duration_text, read_table
from sgvf_drake.paper.running import SCENARIO_FILE, stored_summary

TEMPLATE, STYLE = "report.html", "report.css"
SYMBOLS = {Verdict.HOLDS: "holds", Verdict.PARTLY: "partly", Verdict.FAILS: "fails"}
"""What the style sheet and the symbols on the page call the verdicts."""


def build_page(summary: Mapping[str, Any], folder: Path) -> str:
    """Returns the report of a reproduction in a folder, as an HTML file, by its summary."""
    loader = PackageLoader("sgvf_drake.paper.report")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    option = " --override quick" if summary["quick"] else ""
    sections = [
        {
            **{"name": name, "command": f"sgvf run {name}{option} --out {name}"},
            **entry,
            **_result(folder / name, entry["status"]),
        }
        for name, entry in summary["scenarios"].items()
    ]
    return environment.get_template(TEMPLATE).render(
        # The style sheet is ours; everything else is escaped.
        style=Markup(loader.get_source(environment, STYLE)[0]),
        sections=sections,
        symbols=SYMBOLS,
        time=duration_text(summary["trial_s"]),
        wall=duration_text(summary["wall_s"]),
        summary=summary,
        missing=[section for section in sections if section["status"] == "missing"],
        failed=[section for section in sections if section["status"] == "failed"],
    )


def _result(folder: Path, status: str) -> dict[str, Any]:
    """Returns what is shown of the result of a scenario; it is empty where there is none."""
    summary = stored_summary(folder) if status in ("done", "outdated") else None
    if summary is None:
        return {"claims": [], "exhibits": [], "thumbnail": None, "facts": {}, "scenario": ""}
    exhibits = [
        {
            "caption": one["caption"],
            **(
                {"picture": embed(folder / one["file"])}
                if one["file"].endswith(".png")
                else {"table": read_table(folder / one["file"])}
            ),
        }
        for one in summary["exhibits"]
    ]
    pictures = [one["file"] for one in summary["exhibits"] if one["file"].endswith(".png")]
    seeds = summary["seeds"]
    facts = {
        "Seeds" if len(seeds) > 1 else "Seed": ", ".join(map(str, seeds)) or "none",
        "Trials": duration_text(summary["trial_s"]),
        "Last run": duration_text(summary["wall_s"]),
    }
    return {
        "claims": summary["claims"],
        "exhibits": exhibits,
        "thumbnail": embed(folder / pictures[0], thumbnail=True) if pictures else None,
        "facts": facts | ({"Commit": summary["commit"]} if summary["commit"] else {}),
        "scenario": (folder / SCENARIO_FILE).read_text(encoding="utf-8"),
    }
