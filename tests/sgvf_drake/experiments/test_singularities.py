"""The singularities of a field: what the experiment leaves behind."""

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments import run_singularities
from sgvf_drake.experiments.figures.singularities import MARKS, plot_zeros
from sgvf_drake.experiments.singularities import singularity_summary
from sgvf_drake.lyapunov import KINDS, FieldZeros, Singularities, Zero
from sgvf_drake.plotting import new_figure
from tests.helpers import ink, summary_of

FILES = {"summary.json", "zeros.csv", "singularities.png", "log_density.png"}
KEYS = {
    *("zeros", "winding_number", "index_sum", "score_winding_number", "score_index_sum"),
    *("tangent_winding_number", "tangent_index_sum", "undecided", "undecided_by_field"),
    *("cells", "box", "vanishing", "time_s", "unit_length", "reference", "recipe", "seed"),
    "digest",
}


@pytest.fixture(scope="module")
def found(tmp_path_factory, robust_field):
    """The folder of the singularities of a trained field around two rings."""
    out = tmp_path_factory.mktemp("singularities") / "out"
    returned = run_singularities(robust_field, None, out)
    assert returned["index_sum"] == summary_of(out)["index_sum"]
    return out


def test_everything_is_there(found):
    assert {path.name for path in found.iterdir()} == FILES
    summary = summary_of(found)
    assert set(summary) == KEYS
    for prefix in ("", "score_", "tangent_"):
        assert summary[f"{prefix}winding_number"] == summary[f"{prefix}index_sum"]
    assert summary["winding_number"] == 1
    assert summary["undecided"] == 0
    assert summary["undecided_by_field"] == {"guiding": 0, "score": 0, "tangent": 0}
    assert summary["reference"] == "shape"
    assert summary["unit_length"] == pytest.approx(1, rel=1e-3)


def test_the_zeros_are_listed_with_what_is_around_them(found, robust_field, concentric):
    zeros, field = summary_of(found)["zeros"], robust_field
    for zero in zeros:
        assert zero["field"] in ("guiding", "score", "tangent")
        assert zero["kind"] in KINDS
        assert zero["index"] == (-1 if zero["kind"] == "saddle" else 1)
        assert zero["residual"] < 1e-9
        assert ("log_density" in zero) == (zero["field"] != "tangent")
    points = np.array([zero["point"] for zero in zeros if zero["field"] == "score"])
    assert np.abs(field.score(points)).max() < 1e-9
    rings = np.array([zero["path_distance"] for zero in zeros if zero["field"] == "score"])
    assert np.allclose(rings, concentric[1].project(points).distance)


def test_the_table_holds_the_same(found):
    table = pd.read_csv(found / "zeros.csv")
    zeros = summary_of(found)["zeros"]
    assert np.allclose(table[["x", "y"]], [zero["point"] for zero in zeros])
    assert table["kind"].tolist() == [zero["kind"] for zero in zeros]
    assert table.groupby("field")["index"].sum().to_dict() == {
        "guiding": 1,
        "score": 1,
        "tangent": 1,
    }
    columns = [f"eigenvalue_{k}_{part}" for k in (1, 2) for part in ("real", "imag")]
    expected = [np.ravel(zero["eigenvalues"]) for zero in zeros]
    assert np.allclose(table[columns], expected)
    assert not table.loc[table["field"] == "score", "log_density"].isna().any()


def test_the_pictures_are_drawn(found):
    for name in ("singularities.png", "log_density.png"):
        assert 0.05 < ink(found / name) < 0.8


def test_a_field_without_zeros(make_field, tmp_path):
    field = make_field("robust")
    reference = field.network.path, "cloud"
    summary = run_singularities(field, reference, tmp_path / "out")
    assert [zero for zero in summary["zeros"] if zero["field"] != "tangent"] == []
    assert summary["vanishing"]["low_density"] is None
    written = summary_of(tmp_path / "out")
    assert written["vanishing"]["guiding_min_at_score_zeros_on_path"] is None
    assert len(pd.read_csv(tmp_path / "out" / "zeros.csv")) == len(summary["zeros"])


def test_every_part_has_its_own_winding_number():
    centre = Zero(np.zeros(2), 1, "centre", False, "guiding", np.zeros(2, complex), 0.0)
    parts = (FieldZeros(count * (centre,), count + 3, 0, 0) for count in (0, 1, 2))
    box = (np.full(2, -1.0), np.ones(2))
    summary = singularity_summary(Singularities(box, *parts))
    for count, prefix in enumerate(("", "score_", "tangent_")):
        assert summary[f"{prefix}index_sum"] == count
        assert summary[f"{prefix}winding_number"] == count + 3


def test_every_kind_has_its_mark():
    zeros = [
        Zero(np.array([k, 0.0]), 1, kind, stable, "guiding", np.zeros(2, complex), 0.0)
        for k, (kind, stable) in enumerate(
            [*((kind, False) for kind in KINDS), ("focus", True), ("sink", True)]
        )
    ]
    (axes,) = new_figure(1, 1, 4, 4)[1]
    artists = plot_zeros(axes, FieldZeros(tuple(zeros), 1, 0, 0))
    assert set(artists) == set(MARKS)
    drawn = {
        name: artist.get_offsets()[:, 0].astype(int).tolist()
        for name, artist in artists.items()
    }
    assert drawn["unstable focus"] == [3]
    assert drawn["stable focus"] == [6]
    assert drawn["sink"] == [1, 7]
    assert sum(map(len, drawn.values())) == len(zeros)
    looks = {(mark, face, edge) for mark, face, edge in MARKS.values()}
    assert len(looks) == len(MARKS)
