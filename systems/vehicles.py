"""The vehicles by their names: a kind of vehicle is a module, and a row here."""

from sgvf_drake.exceptions import ConfigurationError
from systems.multibody import MultibodyVehicle
from systems.turning_vehicles import FixedWing, Unicycle
from systems.vehicle import Quadrotor, Vehicle

VEHICLES: dict[str, type[Vehicle]] = {
    kind.name: kind for kind in (Quadrotor, MultibodyVehicle, Unicycle, FixedWing)
}
"""The kinds of vehicles by the names of ``sgvf fly --vehicle``."""


def VehicleNamed(name: str) -> type[Vehicle]:
    """Returns a kind of vehicle.

    Raises:
        ConfigurationError: if there is none of this name.
    """
    if name not in VEHICLES:
        raise ConfigurationError(
            f"there is no vehicle {name!r}; there are {', '.join(VEHICLES)}"
        )
    return VEHICLES[name]
