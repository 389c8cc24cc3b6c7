"""A field in C is the field in Python, of which NumPy's is the other form."""

from dataclasses import dataclass, replace
from itertools import product
import re
import subprocess

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.export import C_FILES, export_c
from sgvf_drake.export.c_numbers import PRECISIONS
from sgvf_drake.fields import (
    Composition,
    CurveField,
    FourierCurve,
    ScoreNetwork,
)
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.storage import field_digest
from tests.c_code import CField, compile_c
from tests.fields import (
    COMPOSITIONS,
    DIRECTED_KINDS,
    RECIPES,
    random_directed_field,
    random_field,
)
from tests.helpers import names_in

TOLERANCE = {"mixed": 2e-12, "double": 2e-12, "float": 2e-4}
"""Of errors relative to the largest number beyond 1."""


@dataclass(frozen=True)
class Case:
    """A field of random networks."""

    recipe: str
    composition: str
    dim: int
    ends: int
    score: str
    tangent: str

    def make(self):
        field = random_field(self.recipe, self.dim, ends=self.ends, support=5 * self.ends)
        by_name = {one.name: one for one in ACTIVATIONS}
        score = field.score_model
        if isinstance(score, ScoreNetwork):
            network = replace(score.network, activation=by_name[self.score])
            score = replace(score, network=network)
        tangent = replace(field.tangent_network, activation=by_name[self.tangent])
        composition = COMPOSITIONS[self.composition]
        return replace(
            field, score_model=score, tangent_network=tangent, composition=composition
        )


def cases():
    """Every recipe, composition and dimension; each activation several times with each."""
    names, rows = [one.name for one in ACTIVATIONS], []
    kinds = product(RECIPES, COMPOSITIONS, (2, 3))
    for number, (recipe, composition, dim) in enumerate(kinds):
        ends = number % 3 if composition in ("robust", "unprojected") else 0
        score, tangent = names[number % 7], names[(3 * number + 1) % 7]
        rows.append(Case(recipe, composition, dim, ends, score, tangent))
    return rows


def queries(field, far=30.0):
    """Positions over the box, beside waypoints and on them, far away, at and near ends."""
    rng, cloud = np.random.default_rng(5), field.cloud
    low, high = cloud.box
    box = rng.uniform(low, high, (30, field.dim))
    away = cloud.center + far * (high - low) * rng.uniform(-1, 1, (10, field.dim))
    on = cloud.points[:10]
    beside = on + 0.1 * cloud.unit_length * rng.standard_normal(on.shape)
    return np.concatenate([box, away, on, beside, field.ends, field.ends + 0.01])


def assert_near(found, expected, tolerance):
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale)


def assert_same(code, field, x, tolerance):
    m, J = field.value_and_jacobian(x)
    assert_near(code(x), m, tolerance)
    assert_near(code.jacobian(x), J, tolerance)
    v = np.random.default_rng(1).standard_normal(x.shape)
    assert_near(code.product(x, v), np.einsum("nij,nj->ni", J, v), tolerance)
    by_rows = np.einsum("nij,nj->ni", code.jacobian(x), v)
    assert_near(code.product(x, v), by_rows, tolerance / 20)


@pytest.mark.parametrize(
    ("precision", "case"),
    # Double is what mixed is, bit for bit, as another test says.
    [*product(["mixed"], cases()), *product(["float"], cases()[::3])],
    ids=str,
)
def test_every_field(precision, case, tmp_path):
    field = case.make()
    assert_same(CField(field, tmp_path, precision), field, queries(field), TOLERANCE[precision])


@pytest.mark.full
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("activation", [one.name for one in ACTIVATIONS])
@pytest.mark.parametrize("composition", COMPOSITIONS)
def test_every_combination(composition, activation, precision, tmp_path):
    for dim in (2, 3):
        field = Case("robust", composition, dim, 0, activation, activation).make()
        code = CField(field, tmp_path / str(dim), precision)
        assert_same(code, field, queries(field), TOLERANCE[precision])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", DIRECTED_KINDS)
def test_directed_fields(kind, dim, tmp_path):
    rng = np.random.default_rng(3)
    for precision, ends in (("mixed", True), ("float", False)):
        field = random_directed_field(kind, dim, ends)
        # Its waypoints are no path, so that there is no route.
        code = CField(field, tmp_path / precision, precision, routes=())
        x, tolerance = queries(field), TOLERANCE[precision]
        # Up to twice as long as directions are, and of length zero.
        g = rng.standard_normal(x.shape)
        g[:3] = 0
        v, w = rng.standard_normal((2, *x.shape))
        m, J = field.value_and_jacobian(x, g)
        by_g = field.jacobian_by_direction(x, g)
        assert_near(code(x, g), m, tolerance)
        assert_near(code.jacobian(x, g), J, tolerance)
        assert_near(code.jacobian_by_direction(x, g), by_g, tolerance)
        assert_near(code.tangent(x, g), field.tangent(x, g), tolerance)
        along = np.einsum("nij,nj->ni", J, v)
        assert_near(code.product(x, v, g), along, tolerance)
        along += np.einsum("nij,nj->ni", by_g, w)
        assert_near(code.product(x, v, g, w), along, tolerance)


def test_layers_of_every_width(make_perceptron, tmp_path):
    """Those that are no multiple of what is added at a time, and none at all."""
    rng = np.random.default_rng(2)
    for number, (hidden, frequencies) in enumerate(product([(), (1,), (5, 19, 8)], (0, 3))):
        field = replace(
            random_field("robust"),
            score_model=ScoreNetwork(make_perceptron(rng, 3, hidden, 2, frequencies), 0.7),
            tangent_network=make_perceptron(rng, 2, hidden, 2, frequencies),
        )
        assert_same(CField(field, tmp_path / str(number)), field, queries(field), 2e-12)


@pytest.mark.parametrize("composition", COMPOSITIONS)
def test_at_and_beside_a_zero_of_the_score(composition, tmp_path):
    """On both sides of where the series of the squashed score takes over."""
    field = replace(random_field("robust"), composition=COMPOSITIONS[composition])
    center, score = field.cloud.center[None], field.score_model
    output = score.score(np.zeros((1, 2)))[0] * score.scale
    last = score.network.biases[-1] - output
    network = replace(score.network, biases=(*score.network.biases[:-1], last))
    field = replace(field, score_model=replace(score, network=network))
    assert np.abs(field.score(center)).max() < 1e-14
    steps = np.geomspace(1e-13, 1e-1, 40)[:, None] * field.cloud.unit_length * [0.6, -0.8]
    x = np.concatenate([center, center + steps])
    assert_same(CField(field, tmp_path), field, x, 1e-11)


@pytest.mark.parametrize("name", ["robust", "paper", "exact", "open"])
def test_trained_fields(name, request, tmp_path):
    """What is mixed loses nothing, though most of its numbers are stored in half the bytes."""
    field = request.getfixturevalue(f"{name}_field")
    x = queries(field)
    mixed, double = (
        CField(field, tmp_path / precision, precision) for precision in ("mixed", "double")
    )
    assert_same(mixed, field, x, 2e-12)
    np.testing.assert_array_equal(mixed(x), double(x))
    np.testing.assert_array_equal(mixed.jacobian(x), double.jacobian(x))
    assert mixed.summary["stored_bytes"] < 0.53 * double.summary["stored_bytes"]


def numbers_in(text, array):
    """The numbers of an array, as Python reads hexadecimal ones."""
    body = re.search(rf"{array}\[\d+\] = \{{(.*?)\}};", text, re.DOTALL)[1]
    return np.array([float.fromhex(entry.strip().rstrip("f")) for entry in body.split(",")])


@pytest.mark.parametrize("name", ["robust", "paper"])
def test_numbers_are_written_as_they_are(name, request, tmp_path):
    field = request.getfixturevalue(f"{name}_field")
    export_c(field, tmp_path)
    text = (tmp_path / "field.c").read_text()
    for name, network in (
        ("tangent_network", field.tangent_network),
        ("score_network", field.score_model.network.with_last_input(1.0)),
    ):
        for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            found = numbers_in(text, f"{name}_weights_{layer + 1}")
            np.testing.assert_array_equal(found, W.T.ravel())
            np.testing.assert_array_equal(numbers_in(text, f"{name}_bias_{layer + 1}"), b)
            exact = np.array_equal(W, np.float32(W)) and np.array_equal(b, np.float32(b))
            kind = "float" if exact else "double"
            assert f"const {kind} {name}_weights_{layer + 1}[" in text
        if network.features is not None:
            phases = numbers_in(text, f"{name}_phases")
            np.testing.assert_array_equal(phases, network.features.phases)


def test_what_is_not_a_number_stays_none(robust_field, exact_field, tmp_path):
    x = np.array([[np.nan, 0.0], [0.0, np.nan], [np.inf, 0.0]])
    for number, field in enumerate((robust_field, exact_field)):
        for precision in ("mixed", "float"):
            code = CField(field, tmp_path / f"{precision}{number}", precision)
            assert np.isnan(code(x)).all()
            assert np.isnan(code.jacobian(x)).all()


def test_the_code_has_no_state_and_needs_nothing_but_libm(tee_field, robust_field, tmp_path):
    for name, field in {"directed": tee_field, "plain": robust_field}.items():
        folder = tmp_path / name
        export_c(field, folder)
        compile_c(folder, "-O2", "-fno-pie", "-fno-stack-protector", "-c", "field.c", "laws.c")
        listed = [
            line.split()
            for file in ("field.o", "laws.o")
            for line in subprocess.check_output(["nm", folder / file], text=True).splitlines()
        ]
        kinds = {row[-2] for row in listed}
        # Code, constants, and what others have to define: no data that can be written.
        assert kinds <= set("TtRrU")
        needed = {row[-1] for row in listed if row[-2] == "U"}
        assert needed <= {
            *("sin", "cos", "sincos", "exp", "tanh", "sqrt", "log1p", "atan2", "tan"),
            *("fmod", "floor", "fmin", "fmax", "memcpy", "memset"),
        }


def test_the_written_test_tells_a_wrong_field(tee_field, open_field, tmp_path):
    for name, field in {"directed": tee_field, "plain": open_field}.items():
        folder = tmp_path / name
        for precision in PRECISIONS:
            export_c(field, folder, precision, overwrite=True)
            assert run_test(folder) == (0, "passed")
        code = (folder / "field.c").read_text()
        # One waypoint is moved by a thousandth of U.
        points = "strands_points" if name == "directed" else "score_points"
        first = float(numbers_in(code, points)[0])
        start = code.index("{", code.index(f"{points}[")) + 1
        moved = f"\n    {first + 2e-2!r}f" + code[code.index(",", start) :]
        (folder / "field.c").write_text(code[:start] + moved)
        assert run_test(folder) == (1, "FAILED")


def run_test(folder):
    """The status of the written test, and the first word of its last line."""
    compile_c(folder, "field.c", "field_test.c", "-lm", "-o", "field_test")
    done = subprocess.run([folder / "field_test"], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.splitlines()[-1].split(":")[0]


def test_the_header_tells_which_field_it_is(flight_field, tmp_path):
    origin = (48.1, 11.6, 520.0)
    field = replace(flight_field, cloud=replace(flight_field.cloud, origin=origin))
    summary = export_c(field, tmp_path, "float")
    assert {path.name for path in tmp_path.iterdir()} == set(C_FILES)
    header = (tmp_path / "field.h").read_text()
    defined = dict(re.findall(r"#define FIELD_(\w+) (.+)", header))
    assert defined["DIM"] == "2"
    assert defined["PRECISION"] == '"float"'
    assert defined["DIGEST"] == f'"{field_digest(field)}"'
    assert summary["digest"] == field_digest(field)
    assert float(defined["UNIT_LENGTH"]) == field.cloud.unit_length
    assert float(defined["SIGMA"]) == field.sigma * field.cloud.unit_length
    assert float(defined["APPROACH_LENGTH"]) == field.approach_length
    assert "metres east, north and up\n * of latitude 48.1, longitude 11.6 degrees" in header


class Unknown(Composition):
    def components(self, S, N):
        return S, N

    def value_and_partials(self, S, N):
        return S, S, N


def test_what_cannot_be_exported_is_refused_before_anything_is_written(field, tmp_path):
    cloud = field.cloud
    curve = CurveField(cloud, [FourierCurve.through(cloud, np.arange(5), True)], gain=2.0)
    for other, options, message in (
        (curve, {}, "a CurveField cannot be exported"),
        (field.compiled(), {}, "a CompiledField cannot be exported"),
        (replace(field, composition=Unknown(1.0)), {}, "Unknown has no compiled form"),
        (field, {"precision": "half"}, "precision cannot be 'half'"),
        (field, {"routes": ["1"]}, "it has no routes"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            export_c(other, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_files_are_replaced_only_when_asked(field, tmp_path):
    export_c(field, tmp_path)
    with pytest.raises(OutputExistsError, match=r"already holds field.h, field.c"):
        export_c(field, tmp_path, "float")
    assert '"mixed"' in (tmp_path / "field.h").read_text()
    export_c(field, tmp_path, "float", overwrite=True)
    assert '"float"' in (tmp_path / "field.h").read_text()
    # One file in the way is enough for none to be written.
    other = tmp_path / "other"
    other.mkdir()
    (other / "laws.c").write_text("of somebody else")
    with pytest.raises(OutputExistsError, match=r"already holds laws.c;"):
        export_c(field, other)
    assert names_in(other) == {"laws.c"}
