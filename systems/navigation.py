"""What tells agents in a batch where to go: the automaton of an itinerary, as a system."""

from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector_, EventStatus, LeafSystem_

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.navigator import Navigator, NavigatorState
from systems.scalars import (
    CheckFiniteAgents,
    CheckPositiveParameter,
    ToList,
    ToVector,
    template,
)


@template
def RouteNavigator_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Gives n agents their intended directions along an itinerary.

        .. pydrake_system::

            name: RouteNavigator
            input_ports:
            - positions
            output_ports:
            - intended_directions
            - sections

        `positions` (2 n d) holds place and heading of the n agents one after the other, as
        the state of a kinematic diagram of `DirectedField.with_memory` does.

        `intended_directions` (n d) are those of the sections that the agents are in, and
        `sections` (n) the numbers of these, which laps count on.

        The discrete state holds the `NavigatorState`; it starts at the places that are
        nearest to the agents, by position and heading, and is updated periodically.  The
        outputs depend on it alone, and have no derivatives.

        Args:
            navigator: The automaton, in the unit of the positions.
            num_agents: n.
            period: Of the updates in s.

        Raises:
            ConfigurationError: if an argument cannot be used.
            NonFiniteValueError: on an update, where a position is not finite.
        """

        def _construct(
            self,
            navigator: Navigator,
            num_agents: int,
            period: float,
        ) -> None:
            if num_agents < 1:
                raise ConfigurationError(f"num_agents must be at least 1, got {num_agents}")
            CheckPositiveParameter("period", period)
            self._navigator = navigator
            self._dim = navigator.itinerary.network.dim
            self._count = num_agents
            self._positions = self.DeclareVectorInputPort(
                "positions", 2 * num_agents * self._dim
            )
            start = [0.0] * (num_agents * len(NavigatorState._fields))
            self._index = self.DeclareDiscreteState(BasicVector_[T](start))
            self.DeclareInitializationDiscreteUpdateEvent(self._Start)
            self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._Advance)
            state = {self.discrete_state_ticket(self._index)}
            self.DeclareVectorOutputPort(
                "intended_directions", num_agents * self._dim, self._CalcDirections, state
            )
            self.DeclareVectorOutputPort("sections", num_agents, self._CopySections, state)

        def GetState(self, context: Any) -> NavigatorState:
            """Returns where the agents are; this system's own Context is wanted."""
            values = np.array(ToList(context.get_discrete_state(self._index).CopyToVector()))
            section, *others = values.reshape(-1, self._count)
            return NavigatorState(section.astype(np.intp), *others)

        def _Start(self, context: Any, values: Any) -> EventStatus:
            x, h = self._Agents(context)
            return self._Set(values, self._navigator.start(x, h))

        def _Advance(self, context: Any, values: Any) -> EventStatus:
            x, _ = self._Agents(context)
            return self._Set(values, self._navigator.advance(self.GetState(context), x))

        def _Agents(self, context: Any) -> tuple[np.ndarray, np.ndarray]:
            """Places and headings, (n, d) each."""
            y = np.array(ToList(self._positions.Eval(context))).reshape(self._count, -1)
            CheckFiniteAgents(self, context, "the position", y)
            x, h = np.split(y, 2, axis=1)
            return x, h

        def _Set(self, values: Any, state: NavigatorState) -> EventStatus:
            vector = np.concatenate([np.asarray(part, np.float64) for part in state])
            values.get_mutable_vector(self._index).SetFromVector(ToVector(T, vector.tolist()))
            return EventStatus.Succeeded()

        def _CalcDirections(self, context: Any, output: Any) -> None:
            directions = self._navigator.direction(self.GetState(context))
            output.SetFromVector(ToVector(T, directions.ravel().tolist()))

        def _CopySections(self, context: Any, output: Any) -> None:
            sections = self.GetState(context).section.astype(np.float64)
            output.SetFromVector(ToVector(T, sections.tolist()))

    return Impl


RouteNavigator = RouteNavigator_[None]
