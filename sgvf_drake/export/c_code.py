"""A field as C99 that needs nothing but libm: code, header, and a test of both."""

from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.export.c_field import FieldCode
from sgvf_drake.export.c_laws import laws_constants
from sgvf_drake.export.c_numbers import BYTES, PRECISIONS, literal
from sgvf_drake.export.c_routes import CONSTANTS, navigators_of, route_code
from sgvf_drake.export.c_vectors import TOLERANCES, vectors_of, walk_of
from sgvf_drake.fields import ComposedField, DirectedField
from sgvf_drake.fields.storage import field_digest, write_whole
from sgvf_drake.paths.itinerary import Itinerary

C_FILES = ("field.h", "field.c", "field_test.c", "laws.h", "laws.c")
"""What an export leaves in its folder."""


def export_c(
    field: ComposedField | DirectedField,
    folder: str | PathLike[str],
    precision: str = "mixed",
    *,
    routes: Sequence[Itinerary | str] | None = None,
    certificate: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Writes a field as C99 without dependencies but libm; see the page "Export".

    Args:
        field: A `GuidingField` or a `DirectedField`, as it is to be evaluated: a vehicle at
            a speed follows `systems.FieldForSpeed(field, speed)`.
        folder: Where the files `C_FILES` go; made if it is not there.
        precision: `double`; `float`, numbers and arithmetic; or `mixed`: arithmetic in double,
            with the numbers that are exactly float stored as such.
        routes: Of a directed field, itineraries on its network, or their edges as "1,2,-3",
            whose automata are written too; None: one over each of its pieces.
        certificate: What is proved of the field in this precision, for the header to tell.
        overwrite: Whether files there may be replaced.

    Returns:
        A summary, as plain values: digest, dimension, precision, bytes of numbers, routes.

    Raises:
        ConfigurationError: If the field is of a kind that cannot be exported, the precision is
            unknown, or the routes are none of the field.
        OutputExistsError: If one of the files exists and `overwrite` is false.
    """
    if precision not in PRECISIONS:
        raise ConfigurationError(
            f"precision cannot be {precision!r}; it is one of {', '.join(PRECISIONS)}"
        )
    if not isinstance(field, ComposedField | DirectedField):
        raise ConfigurationError(
            f"a {type(field).__name__} cannot be exported, only a field that was trained or "
            "imported"
        )
    files, summary = _render(field, precision, routes, certificate)
    folder = Path(folder)
    taken = [name for name in files if (folder / name).exists()]
    if taken and not overwrite:
        raise OutputExistsError(
            f"{folder} already holds {', '.join(taken)}; pass overwrite=True to replace them"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_whole(folder / name, text.encode("utf-8"), overwrite=overwrite)
    return summary


def _render(
    field: ComposedField | DirectedField,
    precision: str,
    routes: Sequence[Itinerary | str] | None,
    certificate: str | None,
) -> tuple[dict[str, str], dict[str, Any]]:
    """Returns the texts of all files, and the summary."""
    if routes is not None and not isinstance(field, DirectedField):
        raise ConfigurationError("the field is no directed one; it has no routes")
    code = FieldCode.of(field, precision)
    navigators = navigators_of(field, routes) if isinstance(field, DirectedField) else []
    told = [route_code(number, navigator) for number, navigator in enumerate(navigators)]
    for _, arrays in told:
        code.arrays += arrays
    sigma = field.sigma * field.cloud.unit_length
    walks = [walk_of(number, navigator, sigma) for number, navigator in enumerate(navigators)]
    vectors = vectors_of(field)
    digest = field_digest(field)
    constants = {
        **code.constants,
        **CONSTANTS,
        **laws_constants(),
        "version": version("sgvf-drake"),
        "frame": _frame(field),
        "certificate": certificate,
        "digest": digest,
        "precision": precision,
        "unit_length": literal(field.cloud.unit_length),
        "sigma": literal(sigma),
        "approach_length": literal(field.approach_length),
        "memory_length": literal(sigma),
        "stack": _stack(code),
        "routes": [constants for constants, _ in told],
    }
    of_test = {
        "arrays": vectors + [array for _, arrays in walks for array in arrays],
        "num_points": len(vectors[0].values),
        "tolerance": literal(TOLERANCES[precision]),
        "walks": [walk for walk, _ in walks],
    }
    files = {}
    for name in C_FILES:
        parts = of_test if name == "field_test.c" else {"arrays": code.arrays}
        files[name] = _templates().get_template(f"{name}.j2").render(**constants, **parts)
    summary = {
        "digest": digest,
        "dim": field.dim,
        "directed": isinstance(field, DirectedField),
        "unit_length": field.cloud.unit_length,
        "sigma": field.sigma,
        "precision": precision,
        "stored_bytes": sum(array.num_bytes for array in code.arrays),
        "routes": [constants["edges"] for constants, _ in told],
    }
    return files, summary


@cache
def _templates() -> Any:
    # Imported here: it takes its time, and the command line knows of this module.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("sgvf_drake.export"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _frame(field: ComposedField | DirectedField) -> str:
    if field.cloud.origin is None:
        return ""
    latitude, longitude, height = field.cloud.origin
    return (
        f": metres east, north and up\n * of latitude {latitude!r}, longitude {longitude!r} "
        f"degrees, height {height!r} m"
    )


def _stack(code: FieldCode) -> int:
    """Returns about what a Jacobian takes of it: two jets of a layer, and small ones."""
    rows = 1 + code.constants["dim"]
    jets = 2 * code.constants["width"] + 16 * code.constants["inputs"]
    return rows * jets * BYTES[code.real_type] + 512
