"""Whether the thrust allows a speed on a path, and what it means to lose control there."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import Reference, ReferencePath
from systems import FieldForSpeed, QuadrotorParameters

# Points of the reference at which the demand of the path is read.
DEMAND_SAMPLES = 2_000


@dataclass(frozen=True)
class Feasibility:
    """Whether the thrust allows a speed on the path.

    Attributes:
        demand: Largest speed^2 |J m| on the path, m/s^2: the acceleration of a vehicle
            that moves exactly along the field.
        limit: Horizontal acceleration that the thrust allows in level flight, m/s^2.
    """

    demand: float
    limit: float

    @property
    def is_feasible(self) -> bool:
        """Whether the demand stays below the limit."""
        return self.demand < self.limit


def check_feasibility(
    field: GuidingField, reference: Reference, speed: float, parameters: QuadrotorParameters
) -> Feasibility:
    """Compares the acceleration that the path demands with what the thrust allows.

    The demand is that of the field as it is flown; see `systems.FieldForSpeed`.
    """
    if isinstance(reference, ReferencePath):
        points = np.concatenate([piece.sample(DEMAND_SAMPLES) for piece in reference.pieces])
    else:
        points = field.cloud.points
    m, J = FieldForSpeed(field, speed).value_and_jacobian(points)
    turning = np.linalg.norm(np.einsum("nij,nj->ni", J, m), axis=1)
    return Feasibility(speed**2 * float(turning.max()), parameters.max_horizontal_acceleration)


@contextmanager
def lost_control_named(where: str, speed: float, feasibility: Feasibility) -> Iterator[None]:
    """Makes one clear error of a flight inside that loses control of the vehicle.

    Args:
        where: What was flown, for the message: "piece 1".
        speed: The commanded speed, m/s.
        feasibility: That of the flight.

    Raises:
        ConfigurationError: in place of what Drake's plant raises then.
    """
    try:
        yield
    except (RuntimeError, NonFiniteValueError) as error:
        # How Drake's plant shows that it is out of control: a pitch of 90 degrees.
        if feasibility.is_feasible and "gimbal-lock" not in str(error):
            raise
        raise ConfigurationError(
            f"the quadrotor lost control on {where} at {speed:g} m/s, where "
            f"the path demands {feasibility.demand:.1f} m/s^2 and the thrust allows "
            f"{feasibility.limit:.1f} m/s^2; choose a lower speed"
        ) from error
