"""How the vehicle's state is measured."""

from typing import Any

from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ZeroOrderHold

DEFAULT_SAMPLE_PERIOD = 0.01
"""s; the motion capture of the paper's flights records at 100 Hz."""


def AddMotionCapture(
    builder: DiagramBuilder,
    state_port: OutputPort,
    period: float = DEFAULT_SAMPLE_PERIOD,
    name: str = "motion_capture",
) -> Any:
    """Adds an ideal motion capture: it samples a state and holds it for one period.

    The first sample is taken when a simulation starts to advance; until then the hold
    shows a state of zeros, unless `SetVehicleState` or `SetHover` has set it.

    Args:
        builder: Is changed.
        state_port: The state that is measured.
        period: In s.
        name: Of the system.

    Returns:
        Drake's ZeroOrderHold, connected to `state_port`.
    """
    hold = builder.AddNamedSystem(name, ZeroOrderHold(period, state_port.size()))
    builder.Connect(state_port, hold.get_input_port())
    return hold
