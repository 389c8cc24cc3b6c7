"""Guiding fields: evaluated, differentiated and stored in NumPy; never imports torch."""

from sgvf_drake.fields.base import AdjustableField, Field, FloatArray
from sgvf_drake.fields.composition import Composition, PaperComposition, RobustComposition
from sgvf_drake.fields.guiding import GuidingField, ScoreNetwork
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.parts import ScoreField, TangentField
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron
from sgvf_drake.fields.storage import load_field, save_field

__all__ = [
    "AdjustableField",
    "Composition",
    "Field",
    "FloatArray",
    "FourierFeatures",
    "GaussianMixture",
    "GuidingField",
    "PaperComposition",
    "Perceptron",
    "RobustComposition",
    "ScoreField",
    "ScoreNetwork",
    "TangentField",
    "load_field",
    "save_field",
]
