"""Guiding fields: evaluated, differentiated and stored in NumPy; never imports torch."""

from sgvf_drake.fields.activation import Activation, find_activation
from sgvf_drake.fields.base import AdjustableField, Field, FloatArray
from sgvf_drake.fields.classical import (
    AlgebraicCurve,
    Curve,
    CurveField,
    FourierCurve,
    ImplicitField,
    LagrangeCurve,
    ParametricField,
    PursuitField,
)
from sgvf_drake.fields.compiled import CompiledField
from sgvf_drake.fields.composed import ComposedField, ScoreInducedField
from sgvf_drake.fields.composition import (
    PAPER_GAIN,
    Composition,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
)
from sgvf_drake.fields.directed import (
    DirectedField,
    HeldField,
    MemoryField,
    check_position_alone,
)
from sgvf_drake.fields.guiding import (
    GuidingField,
    ScoreField,
    TangentField,
    import_field,
    load_field,
    load_guiding_field,
)
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron, ScoreNetwork
from sgvf_drake.fields.recovery import recover_waypoints
from sgvf_drake.fields.storage import save_field
from sgvf_drake.fields.strands import StrandMixture, StrandNetwork

__all__ = [
    "PAPER_GAIN",
    "Activation",
    "AdjustableField",
    "AlgebraicCurve",
    "CompiledField",
    "ComposedField",
    "Composition",
    "Curve",
    "CurveField",
    "DirectedField",
    "Field",
    "FloatArray",
    "FourierCurve",
    "FourierFeatures",
    "GaussianMixture",
    "GuidingField",
    "HeldField",
    "ImplicitField",
    "LagrangeCurve",
    "MemoryField",
    "NormalisedComposition",
    "PaperComposition",
    "ParametricField",
    "Perceptron",
    "PursuitField",
    "RobustComposition",
    "ScoreField",
    "ScoreInducedField",
    "ScoreNetwork",
    "StrandMixture",
    "StrandNetwork",
    "TangentField",
    "check_position_alone",
    "find_activation",
    "import_field",
    "load_field",
    "load_guiding_field",
    "recover_waypoints",
    "save_field",
]
