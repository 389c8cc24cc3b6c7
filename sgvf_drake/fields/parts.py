"""The parts of a guiding field, each as a field of its own."""

from dataclasses import dataclass

from sgvf_drake.fields.analytic import AnalyticField
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.guiding import GuidingField


@dataclass(frozen=True, eq=False)
class ScoreField(AnalyticField):
    """The raw score S of a guiding field, per unit of length; as `GuidingField.score`.

    Attributes:
        field: The guiding field.
    """

    field: GuidingField

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.field.cloud)

    def _value(self, z: FloatArray) -> FloatArray:
        return self.field.score_model.score(z) / self.cloud.unit_length

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        S, J = self.field.score_model.score_and_jacobian(z)
        return S / self.cloud.unit_length, J / self.cloud.unit_length


@dataclass(frozen=True, eq=False)
class TangentField(AnalyticField):
    """The tangent field v of a guiding field, no unit; as `GuidingField.tangent`.

    Its zeros are those of the tangent network.

    Attributes:
        field: The guiding field.
    """

    field: GuidingField

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.field.cloud)

    def _value(self, z: FloatArray) -> FloatArray:
        return self.field.composition.tangent(self.field.tangent_network(z))

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        N, J = self.field.tangent_network.value_and_jacobian(z)
        v, by_network = self.field.composition.tangent_and_partial(N)
        return v, by_network @ J
