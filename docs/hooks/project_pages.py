"""Pages of the site that are files of the project outside of `docs`, and the links to them.

The README is the home page, the notebooks are the tutorials, and nothing has a copy.  Links
are written as they work in the repository; here they become links of the site.
"""

from pathlib import Path
import posixpath
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

# MkDocs makes the home page of a README.
PROJECT_FILES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE")
NOTEBOOKS = "notebooks"
# The target of a Markdown link or picture that is a file, not an address or a heading.
TARGET = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
# What nbconvert adds to a notebook: two libraries from a network, for formulas and diagrams.
LOADERS = re.compile(
    r"<!-- Load mathjax -->.*?<!-- End of mermaid configuration -->", flags=re.DOTALL
)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Lists all notebooks, in the order of their numbers, under the heading Tutorials."""
    assert config.nav is not None
    entry = next(entry for entry in config.nav if "Tutorials" in entry)
    entry["Tutorials"] = [*entry["Tutorials"], *_notebooks(_root(config))]
    return config


@event_priority(100)  # Before the plugin that makes pages of the notebooks.
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the files of the project to those of the site."""
    root = _root(config)
    for place in (*PROJECT_FILES, *_notebooks(root)):
        files.append(File(place, str(root), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links between files of the project into links between pages of the site."""
    if not page.file.src_uri.endswith(".md"):
        return markdown
    assert page.file.abs_src_path is not None
    folder = Path(page.file.abs_src_path).parent.relative_to(_root(config)).as_posix()

    def in_site(target: re.Match[str]) -> str:
        place = posixpath.normpath(posixpath.join(folder, target[1])).removeprefix("docs/")
        return posixpath.relpath(place, posixpath.dirname(page.file.src_uri) or ".")

    return TARGET.sub(in_site, markdown)


def on_page_content(html: str, **_: object) -> str:
    """Takes out what would load from a network; no notebook has a formula or a diagram."""
    return LOADERS.sub("", html)


def _root(config: MkDocsConfig) -> Path:
    return Path(config.docs_dir).parent


def _notebooks(root: Path) -> list[str]:
    names = sorted(file.name for file in (root / NOTEBOOKS).glob("*.ipynb"))
    return [f"{NOTEBOOKS}/{name}" for name in names]
