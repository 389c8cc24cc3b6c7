"""Claims: figures, how they are told, and the verdicts that follow from them."""

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from sgvf_drake.paper import findings
from sgvf_drake.paper.claims import Claims, Count, Mean, Share, Span, Verdict, judge
from sgvf_drake.paper.experiment import Exhibit, SeedsTable, count, first, save_rows

DOCS = Path(__file__).parents[3] / "docs"
HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS


@pytest.mark.parametrize(
    ("counts", "verdict"),
    [
        ([(1, 1)], HOLDS),
        ([(1, 2)], PARTLY),
        ([(0, 1)], FAILS),
        ([(0, 0)], FAILS),
        ([(2, 2), (3, 3)], HOLDS),
        ([(2, 2), (0, 3)], PARTLY),
        ([(0, 2), (0, 3)], FAILS),
        ([(0, 0), (3, 3)], PARTLY),
    ],
)
def test_a_verdict_follows_from_counts(counts, verdict):
    assert Verdict.every(*(Count(*count) for count in counts)) is verdict


def test_figures_say_themselves_how_they_are_told():
    for figure, told in (
        (Count.of([True, False, True]), "2 of 3"),
        (Share(0.834), "83%"),
        (Mean(0.5, 0.25, 0.75), "50% [25%, 75%]"),
        (Mean.of([0.5]), "50%"),
        (Span.of([3.0, 1.0, 2.0]), "1 to 3"),
        (Span(0.1, 0.5, percent=True), "10% to 50%"),
    ):
        assert str(figure) == told


def test_a_claim_is_judged_by_its_figures_and_tells_them():
    claims = Claims()

    @claims.add("grow", "Section IX", of_paper=False)
    def grow(rows):
        """Squares
        grow.
        """
        larger = Count.of(rows["squares"]["square"] > 1)
        largest = float(rows["squares"]["square"].max())
        told = {"larger": larger, "largest": largest, "part": Share(0.5)}
        return told, Verdict.every(larger)

    finding = judge(claims[0], {"squares": pd.DataFrame({"square": [1, 4, 1234.5]})})
    assert finding.verdict is PARTLY
    assert finding.evidence == "larger: 2 of 3; largest: 1.23e+03; part: 50%."
    assert (finding.key, finding.source, finding.of_paper) == ("grow", "Section IX", False)
    assert finding.statement == "Squares grow."


def test_a_table_tells_what_the_seeds_of_a_group_say():
    rows = pd.DataFrame(
        {"shape": ["a", "a", "b"], "lap": [0.5, 1.0, 0.25], "good": [True, False, True]}
    )
    columns = {
        "lap": ("lap", (0.0, 1.0)),
        "most": ("lap", pd.Series.max),
        "good": ("good", count),
        "one": ("good", first),
        "both": ("lap", lambda own: {"seeds": len(own), "sum": own.sum()}),
    }
    table = SeedsTable("laps", "How many lap.", columns).of(rows, ("shape",)).content
    one, other = table.to_dict("records")
    assert (one["lap mean"], one["lap low"], one["lap high"]) == (0.75, 0.0, 1.0)
    assert (one["most"], one["good"], one["one"]) == (1.0, "1 of 2", True)
    assert (one["seeds"], one["sum"], other["seeds"], other["sum"]) == (2, 1.5, 1, 0.25)
    intervals = ("lap mean", "lap low", "lap high")
    assert [*table] == ["shape", *intervals, "most", "good", "one", "seeds", "sum"]


def test_the_page_of_findings_judges_stored_rows_and_tells_ours_apart(tmp_path, monkeypatch):
    claims = Claims()

    @claims.add("theirs", "Section IX")
    def grow(rows):
        """Theirs grow."""
        largest = int(rows["squares"]["square"].max())
        return {"largest": largest}, Verdict.when(largest > 3)

    @claims.add("ours", "Section IX", of_paper=False)
    def grow_more(rows):
        """Ours grow."""
        return grow(rows)[0], Verdict.FAILS

    kind = SimpleNamespace(
        findings=lambda rows: [judge(one, rows) for one in claims],
        tables=lambda rows: [Exhibit("squares", "How they grow.", rows["squares"])],
    )
    scenario = SimpleNamespace(title="Squares", source="Fig. 9", experiment=kind)
    monkeypatch.setattr(findings, "scenario_names", lambda: ["alpha", "not run"])
    monkeypatch.setattr(findings, "load_scenario", lambda name: scenario)
    squares = pd.DataFrame({"a|b": ["x", "y"], "square": [1, 4]})
    save_rows({"squares": squares}, tmp_path / "alpha.json")
    theirs, ours, tables = findings.findings_page(tmp_path).split("\n## ")[1:]
    assert "Of 1, 1 hold, 0 hold in part, 0 do not." in theirs
    assert "| Theirs grow | Section IX | holds |" in theirs
    assert "Of 1, 0 hold, 0 hold in part, 1 do not." in ours
    assert "| Ours grow | Section IX | does not hold |" in ours
    assert tables.startswith(
        "Squares (Fig. 9)\n\n- **Theirs grow: holds.** largest: 4.\n"
        "- **Ours grow: does not hold.** largest: 4.\n\nHow they grow.\n\n| a\\|b | square |"
    )
    assert tables.endswith("| x | 1 |\n| y | 4 |\n")


def test_the_page_of_findings_in_the_docs_is_what_the_stored_rows_give():
    page = (DOCS / "findings.md").read_text(encoding="utf-8")
    assert page == findings.findings_page(DOCS / "results")
