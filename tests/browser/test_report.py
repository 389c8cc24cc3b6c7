"""The report as it is read: of experiments of the paper, and of what goes wrong.

A small page with everything that is hard to show is looked at by `make test`; that of real
experiments, those that take least, by `make test-full`; `make bench` runs every experiment.
"""

from collections import Counter
import json

import numpy as np
import pytest

from sgvf_drake.experiments import workbench
from sgvf_drake.paper import run_reproduce, scenario_names
from sgvf_drake.paper.reproduce import REPORT

DESKTOP, PHONE = (1280, 900), (390, 844)
SIZES = [DESKTOP, PHONE]
SCENARIOS = ["fig1_indexing", "fig2_overview", "fig3_flights", "section2_stein"]
# Bytes that a page may have, and the contrast that WCAG asks of text.
LARGEST, CONTRAST = 8_000_000, 4.5

LONG = "a_word_without_a_place_to_break_" * 8

# What reaches over the right edge of the page, but for what is scrolled in a box of its own.
OVERFLOWING = """[...document.querySelectorAll('body *')].filter(element =>
    !element.closest('.scroller, pre, .skip, thead, .symbols') &&
    element.getBoundingClientRect().right > document.documentElement.clientWidth + 1
).map(element => element.outerHTML.slice(0, 200))"""

# Every piece of text with its colour and that of what lies behind it.
COLOURS = """[...document.querySelectorAll('body *')].filter(element =>
    element.checkVisibility() && !element.closest('.symbols, .skip') &&
    [...element.childNodes].some(node => node.nodeType === 3 && node.data.trim())
).map(element => {
    let behind = element;
    while (getComputedStyle(behind).backgroundColor === 'rgba(0, 0, 0, 0)')
        behind = behind.parentElement;
    return [element.outerHTML.slice(0, 100), getComputedStyle(element).color,
            getComputedStyle(behind).backgroundColor];
})"""

IMAGES = """Promise.all([...document.images].map(image => image.decode().then(() => [
    image.naturalWidth, image.naturalHeight, image.width, image.height, image.alt])))"""

BADGES = """[...document.querySelectorAll('main .badge')].map(badge => {
    const box = badge.getBoundingClientRect();
    return [badge.textContent.trim(), badge.checkVisibility(), box.left, box.right, box.height,
            badge.querySelector('svg').getBoundingClientRect().width];
})"""


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """Experiments of the paper, their quick cases: the folder and the summary."""
    out = tmp_path_factory.mktemp("reproduced") / "out"
    return out, run_reproduce(out, quick=True, only=SCENARIOS)


@pytest.fixture(scope="module")
def report(reproduced, open_page):
    """Its page."""
    return open_page((reproduced[0] / REPORT).as_uri())


@pytest.fixture(scope="module")
def troubled(replace_scenarios, open_page, tmp_path_factory):
    """The page of a reproduction with everything that can be hard to show."""
    out = tmp_path_factory.mktemp("troubled") / "out"
    with replace_scenarios(tmp_path_factory.mktemp("scenarios")) as scenarios:
        for verdict in ("holds", "holds in part", "does not hold"):
            name = verdict.replace(" ", "_")
            scenarios.write(name, verdict=verdict, statement=f"{name}: {LONG}", size=10**9)
        scenarios.write("failing", error=LONG)
        run = scenario_names()
        scenarios.write("waiting")
        run_reproduce(out, only=run)
    return open_page((out / REPORT).as_uri())


@pytest.fixture(params=["troubled", pytest.param("report", marks=pytest.mark.full)])
def page(request):
    """Both pages, as they are first seen."""
    page = request.getfixturevalue(request.param)
    show(page, DESKTOP)
    return page


def show(page, size, scheme="light"):
    page.bring_to_front()
    page.resize(*size, mobile=size == PHONE)
    page.emulate(scheme=scheme)
    page.evaluate("scrollTo({top: 0, behavior: 'instant'})")


# What the experiments of the package find, quickly.


@pytest.mark.full
def test_experiments_run_and_put_claims_of_the_paper_to_the_test(reproduced):
    out, summary = reproduced
    errors = {name: summary["scenarios"][name]["error"] for name in SCENARIOS}
    assert errors == dict.fromkeys(SCENARIOS)
    assert (out / REPORT).stat().st_size < LARGEST
    assert {claim["scenario"] for claim in summary["claims"]} == set(SCENARIOS)
    keys = Counter(claim["key"] for claim in summary["claims"])
    assert set(keys.values()) == {1}, keys
    for claim in summary["claims"]:
        assert all(claim[part].strip() for part in ("source", "statement", "evidence")), claim
    of_paper = [claim for claim in summary["claims"] if claim["of_paper"]]
    assert sum(summary["counts"].values()) == len(of_paper) > 5
    for name in SCENARIOS:
        exhibits = json.loads((out / name / "summary.json").read_text())["exhibits"]
        assert any(exhibit["file"].endswith(".png") for exhibit in exhibits), name
        assert all(exhibit["caption"].strip() for exhibit in exhibits), name


def not_to_be_called(*_):
    raise AssertionError("a trial is run that was stored")


@pytest.mark.full
def test_no_trial_is_run_twice_and_the_verdicts_are_the_same(reproduced, monkeypatch):
    out, summary = reproduced
    monkeypatch.setattr(workbench, "_measure", not_to_be_called)
    again = run_reproduce(out, quick=True, only=SCENARIOS)
    assert again["claims"] == summary["claims"]
    assert again["trial_s"] == summary["trial_s"]


# What a reader sees.


def test_the_page_needs_nothing_else_and_complains_of_nothing(page):
    asked = [url for url in page.requests() if not url.startswith("data:")]
    assert len(asked) == 1
    assert asked[0].startswith("file:")
    assert page.complaints() == []


@pytest.mark.parametrize("size", SIZES)
def test_nothing_reaches_over_the_edge(page, size):
    show(page, size)
    widths = "[document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    wanted, there = page.evaluate(widths)
    assert wanted <= there
    assert page.evaluate(OVERFLOWING) == []


@pytest.mark.parametrize("size", SIZES)
def test_every_picture_is_shown_whole(page, size):
    show(page, size)
    images = page.evaluate(IMAGES)
    assert images
    for width, height, shown_width, shown_height, alt in images:
        assert min(width, height) > 0
        assert 0 < shown_width <= size[0]
        if alt:
            # Not distorted.
            assert shown_width / shown_height == pytest.approx(width / height, rel=0.02)


@pytest.mark.parametrize("size", SIZES)
def test_every_verdict_is_seen(page, size):
    show(page, size)
    badges = page.evaluate(BADGES)
    assert len(badges) == 2 * page.evaluate("document.querySelectorAll('.claims li').length")
    assert {text for text, *_ in badges} <= {"holds", "holds in part", "does not hold"}
    for _, visible, left, right, height, symbol in badges:
        assert visible
        assert 0 <= left < right <= size[0]
        assert height > 15
        assert symbol > 8


def test_the_page_is_in_order(page):
    headings = "[...document.querySelectorAll('h1, h2, h3, h4')].map(h => +h.tagName[1])"
    levels = page.evaluate(headings)
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert max(np.diff(levels)) <= 1
    assert page.evaluate("document.documentElement.lang") == "en"
    # Every picture that says something says so in words too; the small ones do not.
    assert page.evaluate(
        "[...document.querySelectorAll('figure')].every(figure => "
        "figure.querySelector('img').alt === figure.querySelector('figcaption').textContent)"
    )


def luminance(colour):
    numbers = colour.removeprefix("rgb").strip("a()").split(",")
    assert len(numbers) == 3, f"{colour} is transparent"
    s = np.array(numbers, dtype=float) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_word_stands_out(page, size, scheme):
    show(page, size, scheme)
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (luminance(background) < 0.5) == (scheme == "dark")
    for element, colour, behind in page.evaluate(COLOURS):
        dark, light = sorted(map(luminance, (colour, behind)))
        assert (light + 0.05) / (dark + 0.05) >= CONTRAST, element


def test_figures_lie_on_white_in_the_dark(page):
    page.emulate(scheme="dark")
    colours = page.evaluate(
        "[...document.querySelectorAll('.card, .group img')].map("
        "card => getComputedStyle(card).backgroundColor)"
    )
    assert set(colours) == {"rgb(255, 255, 255)"}


def test_the_contents_stay_beside_the_page_on_a_desktop(page):
    top = "document.querySelector('.sidebar').getBoundingClientRect().top"
    assert page.evaluate(top) == 0
    page.evaluate("scrollTo({top: 1200, behavior: 'instant'})")
    assert page.evaluate("scrollY") == 1200
    assert page.evaluate(top) == 0
    assert not page.evaluate("document.querySelector('.contents').checkVisibility()")


def test_the_contents_unfold_on_a_phone(page):
    show(page, PHONE)
    link = "document.querySelector('.contents a')"
    visible = f"{link}.checkVisibility()"
    assert not page.evaluate("document.querySelector('.sidebar').checkVisibility()")
    assert not page.evaluate(visible)
    page.evaluate("document.querySelector('.contents summary').click()")
    assert page.evaluate(visible)
    page.evaluate("document.querySelector('.contents summary').click()")
    assert not page.evaluate(visible)


@pytest.mark.full
def test_a_wide_table_is_scrolled_in_its_own_box(report):
    show(report, PHONE)
    boxes = report.evaluate(
        "[...document.querySelectorAll('.scroller')].map(box => { box.scrollLeft = 1e6;"
        "return [box.scrollWidth, box.clientWidth, box.scrollLeft]; })"
    )
    assert boxes
    for wanted, there, scrolled in boxes:
        assert scrolled == pytest.approx(wanted - there, abs=1)
    assert any(scrolled > 0 for *_, scrolled in boxes)
    assert report.evaluate("scrollX") == 0


def test_what_is_printed_is_not_what_is_clicked(page):
    page.emulate(medium="print", scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") in (
        *("rgb(255, 255, 255)", "rgba(0, 0, 0, 0)"),
    )
    for part in (".sidebar", ".contents", ".again"):
        assert not page.evaluate(f"document.querySelector('{part}').checkVisibility()")
    assert page.evaluate("document.querySelector('.verdicts').checkVisibility()")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_not_empty(page, tmp_path, size, scheme):
    show(page, size, scheme)
    picture, png = page.screenshot()
    (tmp_path / "screenshot.png").write_bytes(png)  # For whoever wants to look.
    assert picture.shape[:2] == size[::-1]
    background = picture[-1, -1]
    inked = np.abs(picture - background).max(axis=2) > 0.2
    assert 0.02 < inked.mean() < 0.6
