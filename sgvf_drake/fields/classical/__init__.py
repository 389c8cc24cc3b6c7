"""Fields of the classical kinds, to compare with: computed, not learned."""

from sgvf_drake.fields.classical.algebraic import AlgebraicCurve
from sgvf_drake.fields.classical.curves import Curve, FourierCurve, LagrangeCurve
from sgvf_drake.fields.classical.fields import (
    DEFAULT_GAIN,
    ClassicalField,
    CurveField,
    ImplicitField,
    ParametricField,
    PursuitField,
)

__all__ = [
    "DEFAULT_GAIN",
    "AlgebraicCurve",
    "ClassicalField",
    "Curve",
    "CurveField",
    "FourierCurve",
    "ImplicitField",
    "LagrangeCurve",
    "ParametricField",
    "PursuitField",
]
