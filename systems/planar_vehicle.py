"""A vehicle that holds its speed and its altitude, and turns: a ground robot, a fixed wing."""

from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem_

from systems.disturbances import AddWind, Disturbance
from systems.scalars import (
    CheckFinite,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
    Cos,
    Scalar,
    Sin,
    ToList,
    ToVector,
    template,
)

PLANAR_STATE_SIZE = 7
"""Position (3), heading, velocity over ground (3)."""

HEADING = 3
"""Entry of the heading in the state."""

PLANAR_VELOCITY = slice(4, 7)
"""Entries of the velocity in the state."""


@dataclass(frozen=True)
class PlanarVehicleParameters:
    """What a vehicle of constant airspeed is capable of, in SI units.

    Attributes:
        airspeed: Speed through the air, or over ground where there is no wind, m/s.
        max_turn_rate: Largest rate of the heading to either side, rad/s.
        turn_lag: Time constant with which the turn rate follows what is asked for, s; 0: at
            once.

    Raises:
        ConfigurationError: if a value cannot be used.
    """

    airspeed: float
    max_turn_rate: float
    turn_lag: float = 0.0

    def __post_init__(self) -> None:
        CheckPositiveParameter("airspeed", self.airspeed)
        CheckPositiveParameter("max_turn_rate", self.max_turn_rate)
        CheckNonNegativeParameter("turn_lag", self.turn_lag)

    @property
    def turn_radius(self) -> float:
        """Radius of the tightest turn in still air, m."""
        return self.airspeed / self.max_turn_rate


@template
def PlanarVehicle_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Moves at a constant airspeed along its heading, and turns as fast as it can.

        .. pydrake_system::

            name: PlanarVehicle
            input_ports:
            - turn_rate
            - wind
            output_ports:
            - state

        `turn_rate` (1) in rad/s, to the left, is limited to what the vehicle can do.  `wind`
        (3) is the velocity of the air in W in m/s, whose vertical part changes nothing; not
        connected, the air stands still.

        `state` (7) is the position p_WB (3) in m, the heading in rad from x toward y, and the
        velocity over ground v_WB (3) in m/s: airspeed along the heading, and the wind.

        The continuous state holds (x, y, z, heading), and with a lag the turn rate behind it;
        z stays what it is.

        Args:
            parameters: Airspeed, limit and lag.

        Raises:
            NonFiniteValueError: on evaluation, where an input is not finite.
        """

        def _construct(self, parameters: PlanarVehicleParameters) -> None:
            self._parameters = parameters
            self._lags = parameters.turn_lag > 0.0
            self._turn_rate = self.DeclareVectorInputPort("turn_rate", 1)
            self._wind = self.DeclareVectorInputPort("wind", 3)
            self.DeclareContinuousState(5 if self._lags else 4)
            wind = self.input_port_ticket(self._wind.get_index())
            self.DeclareVectorOutputPort(
                "state", PLANAR_STATE_SIZE, self._CalcState, {self.xc_ticket(), wind}
            )

        @property
        def parameters(self) -> PlanarVehicleParameters:
            """Airspeed, limit and lag."""
            return self._parameters

        def SetVehicleState(self, root_context: Any, state: Any) -> None:
            """Sets position and heading, on a straight course.

            Args:
                root_context: The Context of the whole diagram.
                state: The state (7,), whose velocity follows from heading and wind.
            """
            values = [*state[: HEADING + 1], *([0.0] if self._lags else [])]
            own = self.GetMyMutableContextFromRoot(root_context)
            own.SetContinuousState(ToVector(T, values))

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            """Moves and turns the vehicle."""
            asked = self._turn_rate.Eval(context)
            CheckFinite(self, context, self._turn_rate, ToList(asked))
            limit = self._parameters.max_turn_rate
            turn_rate = min(max(asked[0], T(-limit)), T(limit))
            rates = [*self._CalcVelocity(context), T(0.0), turn_rate]
            if self._lags:
                turning = context.get_continuous_state_vector().GetAtIndex(4)
                rates[3:] = [turning, (turn_rate - turning) / self._parameters.turn_lag]
            derivatives.get_mutable_vector().SetFromVector(ToVector(T, rates))

        def _CalcVelocity(self, context: Any) -> tuple[Scalar, Scalar]:
            """Returns the horizontal velocity over ground in m/s."""
            heading = context.get_continuous_state_vector().GetAtIndex(HEADING)
            vx = self._parameters.airspeed * Cos(heading)
            vy = self._parameters.airspeed * Sin(heading)
            if not self._wind.HasValue(context):
                return vx, vy
            wind = self._wind.Eval(context)
            CheckFinite(self, context, self._wind, ToList(wind))
            return vx + wind[0], vy + wind[1]

        def _CalcState(self, context: Any, output: Any) -> None:
            place = context.get_continuous_state_vector().CopyToVector()[: HEADING + 1]
            output.SetFromVector(ToVector(T, [*place, *self._CalcVelocity(context), T(0.0)]))

    return Impl


PlanarVehicle = PlanarVehicle_[None]


class PlanarVehicleInWind(Diagram):
    """A `PlanarVehicle` in moving air.

    .. pydrake_system::

        name: PlanarVehicleInWind
        input_ports:
        - turn_rate
        output_ports:
        - state
        - wind

    The ports are those of `PlanarVehicle`; `wind` (3) is what blows.  The gusts are those of
    `DisturbedQuadrotor`; see `SetNoiseSeed`.

    Args:
        parameters: The vehicle.
        disturbance: Its wind and gusts; the rest of it is of quadrotors.
    """

    def __init__(self, parameters: PlanarVehicleParameters, disturbance: Disturbance) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self._vehicle: Any = builder.AddNamedSystem("vehicle", PlanarVehicle(parameters))
        wind = AddWind(builder, disturbance)
        builder.Connect(wind, self._vehicle.GetInputPort("wind"))
        builder.ExportInput(self._vehicle.GetInputPort("turn_rate"), "turn_rate")
        builder.ExportOutput(self._vehicle.GetOutputPort("state"), "state")
        builder.ExportOutput(wind, "wind")
        builder.BuildInto(self)

    def SetVehicleState(self, root_context: Context, state: Any) -> None:
        """Sets position and heading; see `PlanarVehicle`."""
        self._vehicle.SetVehicleState(root_context, state)
