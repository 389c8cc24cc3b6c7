"""What can go wrong with a measurement, to see what a flight makes of it."""

from collections.abc import Sequence
import math
from typing import Any

from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from sgvf_drake.exceptions import ConfigurationError
from systems.scalars import SCALARS, ToFloat


@TemplateSystem.define("Dropout_", T_list=SCALARS)  # type: ignore[untyped-decorator, no-untyped-call]
def Dropout_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Loses some entries of a vector for some time: they are NaN then.

        .. pydrake_system::

            name: Dropout
            input_ports:
            - input
            output_ports:
            - output

        Both are vectors of the same size, and the output is the input but for the lost
        entries.  It belongs before what samples: its output depends on the time.

        Args:
            size: Of the vector.
            intervals: When entries are lost: pairs of begin and end in s, the end excluded.
            entries: Which entries are lost: their indices.

        Raises:
            ConfigurationError: if an argument cannot be used.
        """

        def _construct(
            self,
            size: int,
            intervals: Sequence[tuple[float, float]],
            entries: Sequence[int],
            converter: Any = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            for begin, end in intervals:
                if not begin < end:
                    raise ConfigurationError(f"an interval cannot be from {begin} to {end} s")
            for entry in entries:
                if not 0 <= entry < size:
                    raise ConfigurationError(f"there is no entry {entry} of {size}")
            self._arguments: dict[str, Any] = {
                "size": size,
                "intervals": intervals,
                "entries": entries,
            }
            self._intervals, self._entries = tuple(intervals), list(entries)
            self._input = self.DeclareVectorInputPort("input", size)
            self.DeclareVectorOutputPort("output", size, self._CalcOutput)

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, **other._arguments, converter=converter)

        def _CalcOutput(self, context: Any, output: Any) -> None:
            values = self._input.Eval(context).copy()
            time = ToFloat(context.get_time())
            if any(begin <= time < end for begin, end in self._intervals):
                values[self._entries] = T(math.nan)
            output.SetFromVector(values)

    return Impl


Dropout = Dropout_[None]
