"""Fields of the classical kinds, to compare with: computed, not learned."""

from sgvf_drake.fields.classical.algebraic import AlgebraicCurve
from sgvf_drake.fields.classical.base import DEFAULT_GAIN, ClassicalField
from sgvf_drake.fields.classical.curve import Curve
from sgvf_drake.fields.classical.fourier import FourierCurve
from sgvf_drake.fields.classical.implicit import ImplicitField
from sgvf_drake.fields.classical.lagrange import LagrangeCurve
from sgvf_drake.fields.classical.parametric import ParametricField
from sgvf_drake.fields.classical.pursuit import PursuitField
from sgvf_drake.fields.classical.tracking import CurveField

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
