"""The page: numbers as people read them, pictures as they were, and nothing unescaped."""

import base64
from collections import Counter
import html
from html.parser import HTMLParser
import io
import math
import re

import numpy as np
import pandas as pd
from PIL import Image
import pytest

from sgvf_drake.experiments.intervals import interval_columns
from sgvf_drake.paper import run_reproduce, scenario_names
from sgvf_drake.paper.report import (
    build_page,
    cell_text,
    duration_text,
    embed,
    interval_text,
    number_text,
    read_table,
    view_table,
)
from tests.helpers import summary_of

NASTY = "a <b> & \"c\" 'd' {{ e }} </script>"


# Numbers.


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (-0.0, "0"),
        (1.0, "1"),
        (-3.0, "−3"),  # noqa: RUF001
        (0.5, "0.500"),
        (0.9996, "1.00"),
        (0.012345, "0.0123"),
        (0.00099951, "1.00×10⁻³"),  # noqa: RUF001
        (-0.00012345, "−1.23×10⁻⁴"),  # noqa: RUF001
        (12.345, "12.3"),
        (99.96, "100"),
        (1234.5, "1,234"),
        (400_000.0, "400,000"),
        (2.5e7, "2.50×10⁷"),  # noqa: RUF001
        (math.nan, "–"),  # noqa: RUF001
        (math.inf, "∞"),
        (-math.inf, "−∞"),  # noqa: RUF001
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number_text(value) == text


def test_numbers_are_right_to_three_digits():
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for value in 10.0 ** np.linspace(-9, 9, 57) * 1.0371:
        text = number_text(value).replace(",", "")
        mantissa, _, power = text.partition("×10")  # noqa: RUF001
        read = float(mantissa) * 10.0 ** int(power.translate(digits) or 0)
        assert read == pytest.approx(value, rel=5e-3)
        assert len(text) <= 10


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((0.93, 0.8, 1.0), "0.93 [0.80, 1.00]"),
        ((0.0123, 0.0001, 0.0456), "0.0123 [0.0001, 0.0456]"),
        ((123.4, 100.2, 150.9), "123 [100, 151]"),
        ((0.1, -0.25, 0.3), "0.100 [−0.250, 0.300]"),  # noqa: RUF001
        ((0.001, -0.0001, 0.5), "0.001 [0.000, 0.500]"),
        ((1.0, 1.0, 1.0), "1 [1, 1]"),
        ((0.25, math.nan, math.nan), "0.250"),
        ((math.nan, math.nan, math.nan), "–"),  # noqa: RUF001
    ],
)
def test_intervals_share_their_decimals(values, text):
    assert interval_text(*values) == text


def test_cells_are_text_and_times_are_in_words():
    for value, text in (
        *((True, "yes"), (np.False_, "no"), ("None", "None"), (np.int64(12_345), "12,345")),
        *((-3, "−3"), (None, "–"), (pd.NA, "–"), (math.nan, "–")),  # noqa: RUF001
    ):
        assert cell_text(value) == text
    for seconds, text in (
        *((0.04, "0.0 s"), (9.87, "9.9 s"), (9.97, "10 s"), (59.6, "1 min 0 s")),
        *((725.2, "12 min 5 s"), (3_599.8, "1 h 0 min"), (3_900.0, "1 h 5 min")),
    ):
        assert duration_text(seconds) == text


# Tables.


def cells_of(table):
    """The texts of each column by its heading."""
    headings = [heading for heading, _ in table.columns]
    return dict(zip(headings, zip(*table.rows, strict=True), strict=True))


def test_three_columns_of_an_interval_become_one(tmp_path):
    columns = interval_columns("laps", [0.8, 0.9, 1.0])
    rows = [{"variant": name, **columns} for name in ("a", "b")]
    pd.DataFrame(rows).to_csv(tmp_path / "table.csv", index=False)
    table = read_table(tmp_path / "table.csv")
    assert table.columns == [("variant", ""), ("laps", "number")]
    text = interval_text(*columns.values())
    assert table.rows == [("a", text), ("b", text)]
    assert table.intervals


def test_what_is_no_interval_is_not_shown_as_one():
    single = view_table(pd.DataFrame([interval_columns("laps", [0.25])]))
    assert (cells_of(single), single.intervals) == ({"laps": ("0.250",)}, False)
    whole = pd.DataFrame([interval_columns("laps", [0.8, 0.9])])
    for missing in whole.columns:
        part = whole.drop(columns=missing)
        table = view_table(part)
        assert ([*cells_of(table)], table.intervals) == ([*part.columns], False)


def test_a_table_is_read_as_it_was_written(tmp_path):
    pd.DataFrame(
        {
            "variant": ["None", "NA", "null"],
            "count": [1, 2, 3],
            "share": [0.5, math.nan, 1.0],
            "seen": [True, False, True],
            "first": [math.nan, 3, 4],
            "why": ["short", "long " * 20, "short"],
        }
    ).to_csv(tmp_path / "table.csv", index=False)
    table = read_table(tmp_path / "table.csv")
    cells = cells_of(table)
    assert cells["variant"] == ("None", "NA", "null")
    assert cells["count"] == ("1", "2", "3")
    assert cells["share"] == ("0.500", "–", "1")  # noqa: RUF001
    assert cells["seen"] == ("yes", "no", "yes")
    assert cells["first"] == ("–", "3", "4")  # noqa: RUF001
    assert dict(table.columns) == {
        **dict.fromkeys(("count", "share", "first"), "number"),
        **{"variant": "", "seen": "", "why": "prose"},
    }
    empty = view_table(pd.DataFrame(columns=["a", "b"]))
    assert (empty.columns, empty.rows) == ([("a", ""), ("b", "")], [])


# Pictures.


@pytest.fixture
def picture(tmp_path):
    """A picture with all sorts of colours, and its file."""
    pixels = np.random.default_rng(0).integers(0, 256, (300, 500, 3), dtype=np.uint8)
    pixels[50:] = pixels[50]
    path = tmp_path / "picture.png"
    Image.fromarray(pixels).save(path)
    return pixels, path


def decoded(source):
    head, _, data = source.partition(",")
    assert head == "data:image/webp;base64"
    with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as image:
        return np.asarray(image.convert("RGB"))


def test_a_picture_keeps_every_pixel(picture):
    pixels, path = picture
    found = embed(path)
    np.testing.assert_array_equal(decoded(found.source), pixels)
    assert (found.width, found.height) == (500, 300)


def test_a_large_picture_keeps_its_look(tmp_path):
    # Smooth colours with a little noise, which cannot be kept in few bytes.
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 250, 600)[:, np.newaxis, np.newaxis] + np.zeros((600, 400, 3))
    pixels = (ramp + rng.uniform(0, 5, ramp.shape)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "large.png")
    found = embed(tmp_path / "large.png")
    assert len(found.source) < (tmp_path / "large.png").stat().st_size / 3
    error = decoded(found.source).astype(float) - pixels
    assert np.sqrt(np.mean(error**2)) < 3.0


def test_a_thumbnail_is_small_and_of_the_same_shape(picture):
    _, path = picture
    found = embed(path, thumbnail=True)
    assert decoded(found.source).shape == (216, 360, 3)
    assert (found.width, found.height) == (360, 216)


# The page.


class Outline(HTMLParser):
    """What is on a page: elements with their attributes, and its text."""

    VOID = frozenset(["meta", "link", "img", "use", "path", "circle", "br"])

    def __init__(self, page):
        super().__init__()
        self.elements, self.open, self.texts = [], [], []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.texts.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


@pytest.fixture(scope="module")
def reproduced(replace_scenarios, tmp_path_factory):
    """The folder of a reproduction with everything that is told."""
    out = tmp_path_factory.mktemp("reproduced") / "out"
    with replace_scenarios(tmp_path_factory.mktemp("scenarios")) as scenarios:
        scenarios.write("alpha", statement=f"One grows {NASTY}.", seeds=[1, 2, 300])
        scenarios.write("beta", verdict="holds in part", statement="Two grows.")
        scenarios.write("gamma", verdict="does not hold", statement="Three grows.")
        scenarios.write("ours", verdict="does not hold", of_paper=False)
        scenarios.write("wrong", error=NASTY)
        run = scenario_names()
        scenarios.write("zeta")
        run_reproduce(out, only=run)
    return out


@pytest.fixture(scope="module")
def page(reproduced):
    """Its page."""
    return Outline((reproduced / "report.html").read_text(encoding="utf-8"))


def test_every_verdict_is_on_the_page_and_those_of_ours_are_not_counted(page):
    assert "1 holds 1 holds in part 1 does not hold 3 claims put to the test." in page.text
    for statement in (f"One grows {NASTY}.", "Two grows.", "Three grows."):
        # In the table, at the scenario, and among its options.
        assert page.text.count(statement) == 3
    assert page.text.count("Squares grow. ours") == 1
    kinds = Counter(attributes.get("class") for attributes in page.all("span"))
    assert [kinds[f"badge {kind}"] for kind in ("holds", "partly", "fails")] == [2, 2, 4]
    # A verdict is a word and a symbol, not a colour alone.
    for words in ("holds", "holds in part", "does not hold"):
        assert re.search(rf"\b{words}\b", page.text)
    assert {at["href"] for at in page.all("use")} == {"#holds", "#partly", "#fails"}


def test_links_lead_to_places_on_the_page(page):
    places = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(places) == len(set(places))
    links = [attributes["href"] for attributes in page.all("a") + page.all("use")]
    assert {"#alpha", "#zeta", "#alpha.grow"} <= set(links)
    assert {link.removeprefix("#") for link in links} <= set(places)
    labels = [at["aria-labelledby"] for _, at in page.elements if "aria-labelledby" in at]
    assert set(labels) <= set(places)


def test_a_page_is_whole_in_itself_and_says_how_to_run_it_again(page):
    assert page.all("script") == []
    sources = [attributes["src"] for attributes in page.all("img")]
    assert all(source.startswith("data:image/webp;base64,") for source in sources)
    assert [at["href"] for at in page.all("link")] == ["data:,"]
    assert "url(" not in "".join(page.texts)
    # A thumbnail and a figure of each of the four that ran.
    assert Counter(at["alt"] for at in page.all("img")) == {"": 4, "How squares grow.": 4}
    assert page.text.count("The same in numbers.") == 4
    assert "270,000" in page.text
    assert all(at["scope"] in ("col", "row", "rowgroup") for at in page.all("th"))
    assert len(page.all("caption")) == len(page.all("table")) == 1 + 4
    assert "sgvf run alpha --out alpha" in page.text
    assert "experiment: !FakeExperiment" in page.text
    assert "Seeds 1, 2, 300" in page.text


def test_what_is_missing_or_failed_is_told_and_escaped(page, reproduced):
    assert "Failed, 1 of 6 scenarios: wrong ." in page.text
    assert "Missing, 1 of 6 scenarios: zeta ." in page.text
    assert f"RuntimeError: {NASTY}" in page.text
    assert "Not run yet." in page.text
    assert page.all("b") == []
    text = (reproduced / "report.html").read_text(encoding="utf-8")
    assert html.escape(NASTY).replace("&quot;", "&#34;").replace("&#x27;", "&#39;") in text
    # It can be built again from the folder.
    assert build_page(summary_of(reproduced), reproduced) == text


def test_a_quick_page_on_which_nothing_was_found_says_so(fake_scenarios, tmp_path):
    fake_scenarios.write("alpha", error="no ink")
    run_reproduce(tmp_path, quick=True)
    page = Outline((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "No claim put to the test." in page.text
    assert page.all("img") == []
    assert "Quick reproduction" in page.text
    assert "sgvf run alpha --override quick --out alpha" in page.text
    assert "sgvf reproduce --quick" in page.text
