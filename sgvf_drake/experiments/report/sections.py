"""A scenario as the page shows it, from the folder of its result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.report.numbers import duration_text
from sgvf_drake.experiments.report.pictures import Embedded, embed, embed_thumbnail
from sgvf_drake.experiments.report.tables import TableView, read_table, view_table
from sgvf_drake.experiments.reproduction import Status
from sgvf_drake.experiments.running import SCENARIO_FILE, stored_summary


@dataclass(frozen=True)
class PictureView:
    """A figure on the page.

    Attributes:
        caption: What is seen and what it means.
        picture: The figure itself.
    """

    caption: str
    picture: Embedded


@dataclass(frozen=True)
class SectionView:
    """A scenario on the page.

    Attributes:
        name: Of the scenario.
        title: What it shows.
        source: Where the paper has it.
        command: What runs it alone.
        status: How it stands with it.
        error: Why there is no result, if it was tried.
        claims: With their verdicts.
        exhibits: Figures and tables in reading order.
        thumbnail: Its first figure, small.
        facts: Seeds, times and where the code was, by name.
        scenario: The scenario as YAML.
    """

    name: str
    title: str
    source: str
    command: str
    status: Status
    error: str | None = None
    claims: Sequence[Claim] = ()
    exhibits: Sequence[PictureView | TableView] = ()
    thumbnail: Embedded | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    scenario: str = ""


def view_section(
    name: str, entry: Mapping[str, Any], folder: Path, command: str
) -> SectionView:
    """Returns a scenario as it is shown.

    Args:
        name: Of the scenario.
        entry: What the reproduction says of it.
        folder: Its result; read only where the entry says that there is one.
        command: What runs it alone.
    """
    shared: dict[str, Any] = {
        **{"name": name, "title": entry["title"], "source": entry["source"]},
        **{"command": command, "status": Status(entry["status"]), "error": entry["error"]},
    }
    summary = stored_summary(folder) if Status(entry["status"]).has_result else None
    if summary is None:
        return SectionView(**shared)
    pictures = [one["file"] for one in summary["exhibits"] if one["file"].endswith(".png")]
    return SectionView(
        **shared,
        claims=claims_of(summary),
        exhibits=[_view_exhibit(folder / one["file"], one) for one in summary["exhibits"]],
        thumbnail=embed_thumbnail(folder / pictures[0]) if pictures else None,
        facts=_facts(summary),
        scenario=(folder / SCENARIO_FILE).read_text(encoding="utf-8"),
    )


def claims_of(summary: Mapping[str, Any]) -> list[Claim]:
    """Returns the claims of a stored summary."""
    return [
        Claim(**{**claim, "verdict": Verdict(claim["verdict"])}) for claim in summary["claims"]
    ]


def _view_exhibit(path: Path, entry: Mapping[str, str]) -> PictureView | TableView:
    if path.suffix == ".png":
        return PictureView(entry["caption"], embed(path))
    return view_table(read_table(path), entry["caption"])


def _facts(summary: Mapping[str, Any]) -> dict[str, str]:
    seeds = summary["seeds"]
    facts = {
        "Seeds" if len(seeds) > 1 else "Seed": ", ".join(map(str, seeds)) or "none",
        "Trials": duration_text(summary["trial_s"]),
        "Last run": duration_text(summary["wall_s"]),
    }
    if summary["commit"] is not None:
        facts["Commit"] = summary["commit"]
    return facts
