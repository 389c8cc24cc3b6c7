"""Vectors put one after the other, without a dependence on time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from systems.scalars import SCALARS


@TemplateSystem.define("Concatenation_", T_list=SCALARS)  # type: ignore[untyped-decorator, no-untyped-call]
def Concatenation_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Puts its input vectors one after the other.

        .. pydrake_system::

            name: Concatenation
            input_ports:
            - u0
            - u(n-1)
            output_ports:
            - output

        It does what Drake's Multiplexer does, whose output counts as dependent on the time:
        behind one, everything is evaluated anew in every stage of the integrator, even
        where the inputs are held between samples.

        Args:
            sizes: Of the inputs.
        """

        def _construct(self, sizes: Sequence[int], converter: Any = None) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            self._sizes = tuple(sizes)
            self._inputs = [
                self.DeclareVectorInputPort(f"u{k}", size) for k, size in enumerate(sizes)
            ]
            self.DeclareVectorOutputPort(
                "output", sum(sizes), self._CalcOutput, {self.all_input_ports_ticket()}
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, other._sizes, converter=converter)

        def _CalcOutput(self, context: Any, output: Any) -> None:
            output.SetFromVector(np.concatenate([port.Eval(context) for port in self._inputs]))

    return Impl


Concatenation = Concatenation_[None]
