"""The page itself: one HTML file that needs no other, and no script."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.report.numbers import duration_text
from sgvf_drake.experiments.report.sections import SectionView, view_section
from sgvf_drake.experiments.reproduction import Status

TEMPLATE, STYLE = "report.html", "report.css"
SYMBOLS = {Verdict.HOLDS: "holds", Verdict.PARTLY: "partly", Verdict.FAILS: "fails"}
"""What the style sheet and the symbols on the page call the verdicts."""


def build_page(summary: Mapping[str, Any], folder: Path) -> str:
    """Returns the report of a reproduction as an HTML file.

    Args:
        summary: Its `summary.json`.
        folder: Where the results of its scenarios are, each in a folder of its name.
    """
    environment = Environment(
        loader=PackageLoader("sgvf_drake.experiments.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    loader = environment.loader
    assert loader is not None
    option = " --override quick" if summary["quick"] else ""
    sections = [
        view_section(name, entry, folder / name, f"sgvf run {name}{option} --out {name}")
        for name, entry in summary["scenarios"].items()
    ]
    claims = [claim for section in sections for claim in section.claims]
    of_paper = [claim for claim in claims if claim.of_paper]
    counts = Counter(claim.verdict for claim in of_paper)
    return environment.get_template(TEMPLATE).render(
        # The style sheet is ours; everything else is escaped.
        style=Markup(loader.get_source(environment, STYLE)[0]),
        sections=sections,
        counts={verdict: counts[verdict] for verdict in Verdict},
        symbols=SYMBOLS,
        sentence=_sentence(of_paper, sections),
        time=duration_text(summary["trial_s"]),
        wall=duration_text(summary["wall_s"]),
        summary=summary,
        missing=[section for section in sections if section.status is Status.MISSING],
        failed=[section for section in sections if section.status is Status.FAILED],
    )


def _sentence(claims: Iterable[Claim], sections: Iterable[SectionView]) -> str:
    """The verdicts in words: "Of 9 claims put to the test in 2 scenarios, 7 hold ..."."""
    counts = Counter(claim.verdict for claim in claims)
    total = sum(counts.values())
    if total == 0:
        return "No claim has been put to the test yet."
    words = {
        Verdict.HOLDS: ("holds", "hold"),
        Verdict.PARTLY: ("holds in part", "hold in part"),
        Verdict.FAILS: ("does not hold", "do not hold"),
    }
    parts = [
        f"{counts[verdict]} {one if counts[verdict] == 1 else many}"
        for verdict, (one, many) in words.items()
        if counts[verdict]
    ]
    tested = sum(bool(section.claims) for section in sections)
    last = f" and {parts.pop()}" if len(parts) > 1 else ""
    return (
        f"Of {total} claim{'' if total == 1 else 's'} put to the test in {tested} "
        f"scenario{'' if tested == 1 else 's'}, {', '.join(parts)}{last}."
    )
