"""Where a quadrotor looks: along its path, or towards a point."""

import math
from typing import Any

import numpy as np
import pydrake.math
from pydrake.systems.framework import BasicVector_, LeafSystem_

from sgvf_drake.exceptions import ConfigurationError
from systems.scalars import (
    CheckFinite,
    CheckFiniteParameter,
    Scalar,
    ToFloat,
    ToList,
    ToVector,
    template,
)
from systems.se3_law import SLOW_SPEED
from systems.sensing import DEFAULT_SAMPLE_PERIOD

NEAR = 0.1
"""m; nearer to a point than this, its direction is not known well enough to turn there."""


@template
def HeadingSystem_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Tells a vehicle where to look: along its path, or towards a point.

        .. pydrake_system::

            name: HeadingSystem
            input_ports:
            - position
            - velocity_command
            output_ports:
            - heading

        `position` (3) is p_WB in m and `velocity_command` (3) in m/s, both in W.

        `heading` (1) is the desired yaw angle in rad, from -pi to pi: that of the commanded
        velocity, or that from the position to the point.  It is direct feed-through.

        Where the command is slower than `systems.se3_law.SLOW_SPEED`, or the point nearer than
        `NEAR`, in the plane, there is no such direction: the last one is kept.  It is the
        discrete state (1), sampled every `DEFAULT_SAMPLE_PERIOD`; see `SetHeading`.

        Args:
            point: To look towards, (2,) in m in W; None: along the path.

        Raises:
            ConfigurationError: if the point is none.
            NonFiniteValueError: on evaluation, where an input is not finite.
        """

        def _construct(self, point: tuple[float, float] | None = None) -> None:
            if point is not None:
                if len(point) != 2:
                    raise ConfigurationError(f"point must have 2 values, got {len(point)}")
                for value in point:
                    CheckFiniteParameter("point", value)
            self._point = point
            self._position = self.DeclareVectorInputPort("position", 3)
            self._velocity_command = self.DeclareVectorInputPort("velocity_command", 3)
            self._kept = self.DeclareDiscreteState(BasicVector_[T]([0.0]))
            self._heading = self.DeclareVectorOutputPort(
                "heading",
                1,
                self._CalcHeading,
                {self.all_input_ports_ticket(), self.discrete_state_ticket(self._kept)},
            )
            self.DeclarePeriodicDiscreteUpdateEvent(DEFAULT_SAMPLE_PERIOD, 0.0, self._Keep)

        def SetHeading(self, context: Any, heading: Scalar) -> None:
            """Sets the heading in rad that is kept; this system's own Context is wanted."""
            CheckFiniteParameter("heading", heading)
            context.SetDiscreteState(self._kept, ToVector(T, [heading]))

        def _CalcHeading(self, context: Any, output: Any) -> None:
            position = self._position.Eval(context)
            command = self._velocity_command.Eval(context)
            for port, values in ((self._position, position), (self._velocity_command, command)):
                CheckFinite(self, context, port, ToList(values))
            if self._point is None:
                (x, y), least = command[:2], SLOW_SPEED
            else:
                (x, y), least = np.array(self._point) - position[:2], NEAR
            if math.hypot(ToFloat(x), ToFloat(y)) < least:
                output.SetFromVector(context.get_discrete_state(self._kept).CopyToVector())
            else:
                output.SetAtIndex(0, pydrake.math.atan2(y, x))

        def _Keep(self, context: Any, discrete: Any) -> None:
            discrete.get_mutable_vector(self._kept).SetFromVector(self._heading.Eval(context))

    return Impl


HeadingSystem = HeadingSystem_[None]
