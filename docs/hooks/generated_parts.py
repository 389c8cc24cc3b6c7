"""Parts of pages that are written from the project: its commands, notebooks and scenarios.

A page says where a part belongs by a comment with its name, as in `<!-- commands -->`.
"""

from collections.abc import Callable
import json
from pathlib import Path
import re
import subprocess
import sys

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.pages import Page
import yaml

MARK = re.compile(r"^<!-- (\w+) -->$", flags=re.MULTILINE)


@event_priority(100)  # Before the links are those of the site.
def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: object) -> str:
    """Puts the parts where a page has their marks."""
    if not page.file.src_uri.endswith(".md"):
        return markdown
    root = Path(config.docs_dir).parent
    return MARK.sub(lambda mark: PARTS[mark[1]](root), markdown)


def _commands(root: Path) -> str:
    """Returns a section for each command, with its help, as typer writes them."""
    page = subprocess.run(
        [sys.executable, "-m", "typer", "sgvf_drake.cli", "utils", "docs", "--name", "sgvf"],
        check=True,
        capture_output=True,
        text=True,
        cwd=root,
    ).stdout
    _, heading, sections = page.partition("## `sgvf ")
    # One level lower: they are parts of a section.
    return re.sub(r"^(?=#)", "#", heading + sections, flags=re.MULTILINE)


def _notebooks(root: Path) -> str:
    """Returns a list of the notebooks, by their titles."""
    lines = []
    for file in sorted((root / "notebooks").glob("*.ipynb")):
        first = json.loads(file.read_text(encoding="utf-8"))["cells"][0]["source"]
        title = "".join(first).splitlines()[0].removeprefix("# ")
        lines.append(f"- [{title}](../notebooks/{file.name})")
    return "\n".join(lines)


def _scenarios(root: Path) -> str:
    """Returns a table of the scenarios, and of what the paper has them for."""
    rows = ["| scenario | shows | in the paper | overrides |", "|---|---|---|---|"]
    for file in sorted((root / "sgvf_drake" / "paper" / "scenarios").glob("*.yaml")):
        # The base loader does not care for tags: their classes would import Drake.
        base, *overrides = (parts := yaml.load(file.read_text("utf-8"), yaml.BaseLoader))
        scenario, names = parts[base], ", ".join(f"`{name}`" for name in overrides)
        rows.append(f"| `{file.stem}` | {scenario['title']} | {scenario['source']} | {names} |")
    return "\n".join(rows)


PARTS: dict[str, Callable[[Path], str]] = {
    "commands": _commands,
    "notebooks": _notebooks,
    "scenarios": _scenarios,
}
