"""The zeros of a guiding field, of its score and of its tangent, and what they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as entry
from typing import Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    Field,
    GuidingField,
    NormalisedComposition,
    PaperComposition,
    ScoreField,
    TangentField,
    check_position_alone,
)
from sgvf_drake.lyapunov.winding import box_corners, winding_number
from sgvf_drake.lyapunov.zero_search import find_zeros

KINDS = ("source", "sink", "saddle", "focus", "centre", "degenerate")
"""What a zero can be: eigenvalues with real parts of both signs (saddle) or of one, all of them
real (source, sink) or two of them complex (focus); two imaginary ones (centre), or not told."""

PartName = Literal["guiding", "score", "tangent"]
"""The name of one of `PARTS`."""

PARTS: tuple[PartName, ...] = ("guiding", "score", "tangent")
"""Of what zeros are looked for: m, the raw score S, and the tangent network."""

NEGLIGIBLE = 1e-6
"""An imaginary or a real part below this share of the eigenvalue is zero: rounding splits a
double eigenvalue by the square root of 1e-16."""

BOX_GROWTH = (1.0, 1.001, 1.002)
"""Where a field vanishes on the border of the box, a box larger by this is taken."""

Box = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class KnownZero:
    """A zero of a field, found or proved.

    Attributes:
        point: (d,) where it is, in the unit of the waypoints.
        index: Its Poincare index: the sign of det J of a simple one.  In space it is 1 of a
            saddle that is left along a line, and -1 of one that is left along a surface.
        kind: One of `KINDS`, or `unknown` where bounds do not tell.
        stable: Whether it attracts all nearby; None: bounds do not tell.
    """

    point: FloatArray
    index: int
    kind: str
    stable: bool | None


AnyZero = TypeVar("AnyZero", bound=KnownZero)


@dataclass(frozen=True, eq=False)
class KnownZeros(Generic[AnyZero]):
    """The zeros of one field in a box, found or proved.

    Attributes:
        zeros: The zeros.
        winding_number: How often the field turns along the border of the box,
            counter-clockwise; None: this is not proved, or the field is not planar.
        undecided: Number of places where it is open whether there is a zero.
        dim: The dimension d of the space.
    """

    zeros: tuple[AnyZero, ...]
    winding_number: int | None
    undecided: int
    dim: int = entry(default=2, kw_only=True)

    @property
    def index_sum(self) -> int:
        """The sum of the indices; of all zeros the winding number (Poincare and Hopf)."""
        return sum(zero.index for zero in self.zeros)

    @property
    def points(self) -> FloatArray:
        """Where the zeros are, (k, d)."""
        return np.array([zero.point for zero in self.zeros]).reshape(-1, self.dim)


@dataclass(frozen=True, eq=False)
class Zero(KnownZero):
    """A zero that the search found; see `KnownZero`.

    Attributes:
        field: `guiding`, `score` or `tangent`.
        eigenvalues: (d,) of the Jacobian there, complex; of a field that is normalised, and of
            the tangent, before that.
        residual: The length of the same field there.
    """

    field: str
    eigenvalues: NDArray[np.complex128]
    residual: float


@dataclass(frozen=True, eq=False)
class FieldZeros(KnownZeros[Zero]):
    """The zeros that the search found in a box; see `KnownZeros`.

    Attributes:
        cells: Number of cells over which the field was evaluated.
    """

    cells: int


@dataclass(frozen=True, eq=False)
class Singularities:
    """The zeros of a guiding field and of its parts.

    Attributes:
        box: Lower and upper corner of the box that was searched.
        guiding: The zeros of m.
        score: Those of the raw score S.
        tangent: Those of the tangent network.
    """

    box: Box
    guiding: FieldZeros
    score: FieldZeros
    tangent: FieldZeros

    @property
    def by_field(self) -> Mapping[PartName, FieldZeros]:
        """The zeros of all three, by the names of their fields."""
        return {"guiding": self.guiding, "score": self.score, "tangent": self.tangent}


def find_singularities(field: GuidingField) -> Singularities:
    """Finds the zeros of a field, of its score and of its tangent in its box.

    Raises:
        ConfigurationError: The field is a directed one, or a planar one that vanishes along a
            line that leaves the box.
    """
    check_position_alone(field)
    box, found = _find(field, PARTS)
    return Singularities(box, *found)


def find_guiding_zeros(field: GuidingField) -> FieldZeros:
    """Finds the zeros of a field alone; see `find_singularities`."""
    _, (found,) = _find(field, ("guiding",))
    return found


def kind_of(jacobian: FloatArray) -> str:
    """Returns the kind of a simple zero, from the Jacobian (d, d) there."""
    eigenvalues = np.linalg.eigvals(jacobian)
    real, negligible = eigenvalues.real, NEGLIGIBLE * np.abs(eigenvalues).max()
    turns = np.abs(eigenvalues.imag) > negligible
    if (turns & (np.abs(real) <= negligible)).any():
        return "centre"
    if real.min() < 0 < real.max():
        return "saddle"
    if turns.any():
        return "focus"
    return "source" if real.min() > 0 else "sink"


def _find(field: GuidingField, names: Sequence[PartName]) -> tuple[Box, list[FieldZeros]]:
    """Returns the box that was searched, and the zeros of each part in it."""
    unnormalised = replace(field, composition=PaperComposition(field.composition.gain))
    normalises = isinstance(field.composition, NormalisedComposition)
    parts: dict[PartName, Field] = {
        "guiding": unnormalised if normalises else field,
        "score": ScoreField(field),
        "tangent": TangentField(unnormalised),
    }
    scale = field.mixture.sigma
    box, turns = _clear_box([parts[name] for name in names], field.cloud.box, scale)
    return box, [
        _field_zeros(name, parts[name], box, scale, number)
        for name, number in zip(names, turns, strict=True)
    ]


def _clear_box(
    fields: Sequence[Field], box: Box, spacing: float
) -> tuple[Box, Sequence[int | None]]:
    """Returns a box on whose border no field vanishes, and their winding numbers there.

    In space there are no such numbers, and the box stays what it is.
    """
    if len(box[0]) != 2:
        return box, [None] * len(fields)
    middle, half = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
    for growth in BOX_GROWTH:
        grown = (middle - growth * half, middle + growth * half)
        try:
            corners = box_corners(grown)
            return grown, [winding_number(field, corners, spacing) for field in fields]
        except ConfigurationError as error:
            vanishes = error
    raise vanishes


def _field_zeros(
    name: str, field: Field, box: Box, scale: float, turns: int | None
) -> FieldZeros:
    search = find_zeros(field, box, scale)
    values, jacobians = field.value_and_jacobian(search.points)
    zeros = []
    for number, jacobian in enumerate(jacobians):
        eigenvalues = np.linalg.eigvals(jacobian).astype(np.complex128)
        kind = "degenerate" if search.degenerate[number] else kind_of(jacobian)
        zeros.append(
            Zero(
                field=name,
                point=search.points[number],
                index=int(search.indices[number]),
                kind=kind,
                stable=kind != "centre" and bool(eigenvalues.real.max() < 0),
                eigenvalues=eigenvalues,
                residual=float(np.linalg.norm(values[number])),
            )
        )
    return FieldZeros(tuple(zeros), turns, search.undecided, search.cells, dim=field.dim)
