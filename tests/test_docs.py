"""The site of documentation: it builds, names everything public, and tells nothing twice."""

from collections import defaultdict
from html.parser import HTMLParser
import importlib
import inspect
from itertools import pairwise
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys
from urllib.parse import unquote, urlsplit

import griffe
import pytest
import typer
import yaml

from sgvf_drake import cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
# The page of each package; what `sgvf_drake` itself exports stands on those of its parts.
PAGES = {
    "systems": "api/systems.html",
    "sgvf_drake.clouds": "api/clouds.html",
    "sgvf_drake.paths": "api/paths.html",
    "sgvf_drake.fields": "api/fields.html",
    "sgvf_drake.learning": "api/learning.html",
    "sgvf_drake.lyapunov": "api/lyapunov.html",
    "sgvf_drake.certificate": "api/certificate.html",
    "sgvf_drake.export": "api/export.html",
    "sgvf_drake.experiments": "api/experiments.html",
}
WRITTEN = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted(DOCS.rglob("*.md")),
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
]
HOOKS = ("project_pages", "generated_parts", "formulas")
# So many words in a row are a sentence, and no accident.
SENTENCE = 12


class Page(HTMLParser):
    """The identifiers of a page, its links with their text, and what it loads."""

    def __init__(self, file):
        super().__init__()
        self.ids, self.links, self.loads = set(), [], []
        self.in_link = False
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.ids.add(values.get("id"))
        if tag == "a" and "href" in values:
            self.links.append([values["href"], ""])
            self.in_link = True
        if tag in ("script", "img", "iframe", "source"):
            self.loads.append(values.get("src"))
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(values["href"])

    def handle_endtag(self, tag):
        self.in_link = self.in_link and tag != "a"

    def handle_data(self, data):
        if self.in_link:
            self.links[-1][1] += data


def build(folder, site, **variables):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", **variables}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the site, which is built as the checks build it, and its pages by place."""
    folder = tmp_path_factory.mktemp("site").resolve()
    done = build(ROOT, folder)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    places = [file.relative_to(folder).as_posix() for file in folder.rglob("*.html")]
    return folder, {place: Page(folder / place) for place in places}


@pytest.mark.full
def test_everything_public_is_on_the_pages(site):
    _, pages = site
    # What has no docstring is left out of a page.  A name that is also that of its module
    # stands there by itself, at the end.
    for package, page in PAGES.items():
        for name in importlib.import_module(package).__all__:
            places = {f"{package}.{name}", f"{package}.{name}.{name}"}
            assert places & pages[page].ids, (package, name)
    links = {text: href for href, text in pages["api/index.html"].links}
    for name in importlib.import_module("sgvf_drake").__all__:
        target, _, fragment = links[name].partition("#")
        assert fragment in pages[f"api/{target}"].ids, name
        assert fragment.rpartition(".")[2] == name
    commands = typer.main.get_command(cli.app).commands
    assert len(commands) >= 8
    assert {f"sgvf-{name}" for name in commands} <= pages["commands.html"].ids
    tutorials = {f"notebooks/{file.stem}.html" for file in (ROOT / "notebooks").glob("*.ipynb")}
    assert tutorials <= set(pages)
    assert tutorials <= {href for href, _ in pages["tutorials.html"].links}


@pytest.mark.full
def test_every_scenario_is_listed(site):
    folder, _ = site
    text = (folder / "experiments.html").read_text(encoding="utf-8")
    scenarios = sorted((ROOT / "sgvf_drake" / "paper" / "scenarios").glob("*.yaml"))
    assert scenarios
    for file in scenarios:
        assert f"<code>{file.stem}</code>" in text


@pytest.mark.full
def test_links_lead_somewhere_and_nothing_comes_from_a_network(site):
    folder, pages = site
    checked = 0
    for place, page in pages.items():
        text = (folder / place).read_text(encoding="utf-8")
        assert [load for load in page.loads if urlsplit(load or "").netloc] == [], place
        assert not re.search(r"""import\(\s*["']https?:|//cdn|//unpkg""", text), place
        assert "arithmatex" not in text, "formulas are MathML"
        if place == "404.html":
            continue  # It has links from the root of a server.
        for href in [*(href for href, _ in page.links), *filter(None, page.loads)]:
            parts = urlsplit(href)
            if parts.scheme:
                continue
            file = folder / place
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            assert target.is_file(), (place, href)
            if parts.fragment:
                ids = pages[target.relative_to(folder).as_posix()].ids
                assert unquote(parts.fragment) in ids | {"__codelineno"}, (place, href)
            checked += 1
    assert checked > 1000
    for file in folder.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?https?:", file.read_text("utf-8")), file
    # The index of the search, which a page from the file system cannot fetch.
    assert (folder / "search" / "search_index.js").is_file()
    assert "assets/iframe-worker.js" in pages["index.html"].loads


def prose(file):
    """The words of a source, without code blocks and places of docstrings."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    text = re.sub(r"^```.*?^```$", " ", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^::: .*\n(    .*\n)*", " ", text, flags=re.MULTILINE)
    return re.findall(r"[a-z0-9']+", text.lower())


def told_twice(words_of):
    """The runs of words that stand in more than one source."""
    where = defaultdict(set)
    for source, words in words_of.items():
        for start in range(len(words) - SENTENCE + 1):
            where[" ".join(words[start : start + SENTENCE])].add(source)
    return {run: sources for run, sources in where.items() if len(sources) > 1}


def test_nothing_is_told_twice():
    words_of = {file.relative_to(ROOT).as_posix(): prose(file) for file in WRITTEN}
    assert sum(map(len, words_of.values())) > 5000
    assert told_twice(words_of) == {}


def test_what_is_told_twice_is_found():
    words = [f"word{number}" for number in range(SENTENCE)]
    assert told_twice({"a": ["before", *words], "b": [*words, "after"]})
    assert not told_twice({"a": ["before", *words], "b": words[:-1]})


def blocks(language):
    return [
        block
        for file in sorted(DOCS.glob("*.md"))
        for block in re.findall(
            rf"^```{language}\n(.*?)^```$", file.read_text("utf-8"), flags=re.M | re.S
        )
    ]


def command_lines():
    lines = [line.strip() for block in blocks("sh") for line in block.splitlines()]
    return [line for line in lines if line.startswith("sgvf ")]


def test_commands_parse():
    group = typer.main.get_command(cli.app)
    assert command_lines()
    for line in command_lines():
        _, *arguments = shlex.split(line)
        with group.make_context("sgvf", list(arguments)) as context:
            name, command, rest = group.resolve_command(context, arguments)
            command.make_context(name, rest, parent=context)


def test_scenarios_in_the_docs_are_scenarios(tmp_path):
    from sgvf_drake.paper import load_scenario, scenario_names

    (text,) = (block for block in blocks("yaml") if "scenario:" in block)
    file = tmp_path / "scenario.yaml"
    file.write_text(text, encoding="utf-8")
    overrides = [name for name in yaml.load(text, yaml.BaseLoader) if name != "scenario"]
    assert load_scenario(file).experiment != load_scenario(file, overrides).experiment
    runs = [shlex.split(line) for line in command_lines() if line.startswith("sgvf run ")]
    for run in runs:
        if not run[2].endswith(".yaml"):
            assert run[2] in scenario_names()
            settings = [value for flag, value in pairwise(run) if flag == "--set"]
            load_scenario(run[2], settings=settings)


def test_distributions_in_the_docs_are_read(tmp_path):
    from sgvf_drake.experiments import Distributions, load_distributions

    (text,) = (block for block in blocks("yaml") if "scenario:" not in block)
    file = tmp_path / "distributions.yaml"
    file.write_text(text, encoding="utf-8")
    assert load_distributions(file).draw(0, 0) != Distributions().draw(0, 0)
    written = (DOCS / "montecarlo.md").read_text(encoding="utf-8")
    for name, _ in load_distributions(file).values():
        key = name.partition(".")[2].removesuffix("_x").removesuffix("_y").removesuffix("_z")
        assert re.search(rf"`(\w+\.)?{key}`", written), name


@pytest.fixture
def project(tmp_path):
    """A small project whose pages are those of ours: a README, a guide, a notebook."""
    shutil.copytree(DOCS / "hooks", tmp_path / "docs" / "hooks")
    (tmp_path / "notebooks").mkdir()
    notebook = {"cells": [{"cell_type": "markdown", "source": ["# First\n", "text"]}]}
    (tmp_path / "notebooks" / "00_a.ipynb").write_text(json.dumps(notebook))
    (tmp_path / "README.md").write_text("# Home\n\n[guide](docs/guide.md#part)\n")
    (tmp_path / "docs" / "guide.md").write_text(
        "# Guide\n\n## Part\n\n[home](../README.md), [license](../LICENSE)\n\n"
        "<!-- notebooks -->\n\n$$\\lvert S \\rvert \\le \\sigma$$\n\nand $\\log p < 1$\n"
    )
    for name in ("CHANGELOG.md", "CONTRIBUTING.md", "LICENSE"):
        (tmp_path / name).write_text(f"# {name}\n")
    settings = {
        "site_name": "small",
        "use_directory_urls": False,
        "exclude_docs": "hooks/",
        "hooks": [f"docs/hooks/{name}.py" for name in HOOKS],
        "plugins": [],
        "markdown_extensions": [{"pymdownx.arithmatex": {"generic": True}}],
        "nav": [{"Home": "README.md"}, {"Tutorials": ["guide.md"]}],
        "not_in_nav": "C*.md",
        "validation": {"anchors": "warn"},
    }
    (tmp_path / "mkdocs.yml").write_text(yaml.safe_dump(settings))
    return tmp_path


def test_links_of_the_repository_are_links_of_the_site(project):
    done = build(project, project / "site")
    assert done.returncode == 0, done.stderr
    home, guide = (Page(project / "site" / name) for name in ("index.html", "guide.html"))
    assert ["guide.html#part", "guide"] in home.links
    assert {"index.html", "LICENSE", "notebooks/00_a.ipynb"} <= {h for h, _ in guide.links}
    text = (project / "site" / "guide.html").read_text(encoding="utf-8")
    block, inline = re.findall(r"<math.*?</math>", text, flags=re.DOTALL)
    assert 'display="block"' in block
    assert 'form="prefix">&#x0007C;</mo><mi>S</mi>' in block
    assert "<mi>&#x003C3;</mi>" in block
    assert 'display="inline"' in inline
    assert '<mi>log</mi><mspace width="0.17em"/><mi>p</mi><mo>&#x0003C;</mo>' in inline


def test_a_broken_link_fails_the_build(project):
    links = ["docs/gone.md", "docs/guide.md#gone", "notebooks/9.ipynb"]
    text = "# Home\n\n" + "\n".join(f"[broken]({link})" for link in links)
    (project / "README.md").write_text(text)
    done = build(project, project / "site")
    assert done.returncode != 0
    for name in ("gone.md", "guide.md#gone", "9.ipynb"):
        assert name in done.stderr, name


def test_template_systems_are_read_as_they_are():
    import systems

    # As the pages read the package: without importing it.
    extensions = griffe.load_extensions(str(DOCS / "hooks" / "drake_docstrings.py"))
    read_systems = griffe.load("systems", search_paths=[str(ROOT)], extensions=extensions)
    names = [name for name in systems.__all__ if f"{name}_" in systems.__all__]
    assert len(names) >= 6
    for name in names:
        system, documented = getattr(systems, name), read_systems[name].final_target
        own, read = inspect.getdoc(system), documented.docstring.value.replace("\\*", "*")
        before, diagram, after = re.split(r"(\.\. pydrake_system::\n\n(?: .*\n)+\n)", own)
        # The port diagram has become a table; all else is as it was.
        assert read.startswith(before)
        assert read.endswith(after)
        table = read.removeprefix(before).removesuffix(after)
        assert table.startswith("| input ports | output ports |")
        ports = yaml.safe_load(diagram.partition("\n")[2])
        assert re.findall("`(.*?)`", table) == [*ports["input_ports"], *ports["output_ports"]]
        expected = list(inspect.signature(system._construct).parameters.values())[1:]
        parameters = list(documented.parameters)[1:]
        assert [p.name for p in parameters] == [p.name for p in expected]
        required = [p.name for p in parameters if p.default is None]
        assert required == [p.name for p in expected if p.default is p.empty]
