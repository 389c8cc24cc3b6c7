"""What differs between the flights of a Monte Carlo experiment, as distributions.

They are Drake's (`pydrake.common.schema`), in YAML `!Uniform {min: 0.9, max: 1.1}`,
`!Gaussian {mean: 1, stddev: 0.1}` or `!UniformDiscrete {values: [0, 0.01]}`; a number is always
the same.  Every value of every flight is drawn from a generator of its own, seeded by the
seed, the number of the flight and the name of the value: so a flight can be drawn without those
before it, and another distribution of one value leaves all others as they are.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.common.schema import Deterministic, Gaussian, Uniform, UniformDiscrete
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
import yaml

from sgvf_drake.exceptions import ConfigurationError
from systems import Disturbance, SensorParameters

# Drake's reader wants its classes as they are, and dataclasses that are not frozen.
Distribution = float | Deterministic | Gaussian | Uniform | UniformDiscrete

_AIR, _SENSORS = Disturbance(), SensorParameters()


@dataclass
class StartDistributions:
    """Where a flight starts, at a hover.

    Attributes:
        along: How far along the path, as a part of the length of all its pieces, one after the
            other.
        beside: How far to the left of the path, U.
        above: How far above the altitude of the flight, or in space above the path, m.
    """

    along: Distribution = field(default_factory=lambda: Uniform(0.0, 1.0))
    beside: Distribution = field(default_factory=lambda: Uniform(-0.5, 0.5))
    above: Distribution = 0.0


@dataclass
class DisturbanceDistributions:
    """What disturbs a flight: the values of a `systems.Disturbance`."""

    wind: list[Distribution] = field(default_factory=lambda: list(_AIR.wind))
    gust: Distribution = _AIR.gust
    gust_time: Distribution = _AIR.gust_time
    drag: Distribution = _AIR.drag
    motor_lag: Distribution = _AIR.motor_lag
    mass_factor: Distribution = field(default_factory=lambda: Uniform(0.95, 1.05))
    inertia_factor: Distribution = field(default_factory=lambda: Uniform(0.8, 1.2))
    thrust_factor: Distribution = field(default_factory=lambda: Uniform(0.95, 1.05))


@dataclass
class SensorDistributions:
    """How well a flight is measured: values of `systems.SensorParameters`.

    The delay is a multiple of its sample period, so it is fixed or one of several values.
    """

    delay: Distribution = _SENSORS.delay
    position_noise: Distribution = _SENSORS.position_noise
    attitude_noise: Distribution = _SENSORS.attitude_noise
    rate_noise: Distribution = _SENSORS.rate_noise


@dataclass
class Distributions:
    """The distributions of an experiment.

    Attributes:
        start: Where a flight starts.
        disturbance: What disturbs it.
        sensors: How well it is measured; None: ideally.
    """

    start: StartDistributions = field(default_factory=StartDistributions)
    disturbance: DisturbanceDistributions = field(default_factory=DisturbanceDistributions)
    sensors: SensorDistributions | None = None

    def to_yaml(self) -> str:
        """Returns them as a file that `load_distributions` reads."""
        text: str = yaml_dump_typed(self)
        return text

    def values(self) -> Iterator[tuple[str, Distribution]]:
        """Gives each distribution by the name of its value, as "start.along"."""
        for part in fields(self):
            section = getattr(self, part.name)
            for value in () if section is None else fields(section):
                found = getattr(section, value.name)
                name = f"{part.name}.{value.name}"
                if value.name == "wind":
                    yield from zip((f"{name}_{axis}" for axis in "xyz"), found, strict=True)
                else:
                    yield name, found

    def check(self) -> None:
        """Raises ConfigurationError, with its name, for a value that none can be drawn of."""
        if len(self.disturbance.wind) != 3:
            raise ConfigurationError(
                f"disturbance.wind must have 3 values, not {len(self.disturbance.wind)}"
            )
        for name, distribution in self.values():
            reason = _fault_of(distribution)
            if reason is not None:
                raise ConfigurationError(f"{name}: {reason}")

    def draw(self, seed: int, number: int) -> dict[str, float]:
        """Returns the values of one flight by their names.

        Args:
            seed: That of the experiment.
            number: That of the flight.
        """
        return {
            name: _draw(distribution, seed, number, name)
            for name, distribution in self.values()
        }


def flight_seed(seed: int, number: int, name: str) -> int:
    """Returns the seed of one thing that is random in a flight, of 32 bits.

    Args:
        seed: That of the experiment.
        number: That of the flight.
        name: What is random.
    """
    sequence = np.random.SeedSequence([seed, number, *name.encode()])
    return int(sequence.generate_state(1)[0])


def _draw(distribution: Distribution, seed: int, number: int, name: str) -> float:
    if isinstance(distribution, float | int):
        return float(distribution)
    return float(distribution.Sample(RandomGenerator(flight_seed(seed, number, name))))


def _fault_of(distribution: Distribution) -> str | None:
    """Returns why a distribution is none; Drake draws from any."""
    match distribution:
        case Uniform(min=low, max=high):
            numbers, fault = [low, high], low > high and f"min {low} is above max {high}"
        case Gaussian(mean=mean, stddev=stddev):
            numbers, fault = [mean, stddev], stddev < 0 and f"stddev {stddev} is negative"
        case UniformDiscrete(values=values):
            numbers, fault = list(values), len(values) == 0 and "there are no values"
        case Deterministic(value=value):
            numbers, fault = [value], False
        case _:
            numbers, fault = [distribution], False
    if not np.isfinite(numbers).all():
        return f"{numbers} is not finite"
    return fault or None


def load_distributions(file: str | Path | None = None) -> Distributions:
    """Reads distributions; what a file does not name is as it is without one.

    Args:
        file: A YAML file; None: there is none.

    Raises:
        ConfigurationError: If there is no such file, if a key in it is unknown, or if a value
            cannot be used; the message names it.
    """
    if file is None:
        return Distributions()
    try:
        loaded: Any = yaml_load_typed(
            schema=Distributions, filename=str(file), defaults=Distributions()
        )
        loaded.check()
    except OSError as error:
        raise ConfigurationError(f"cannot read {file}: {error.strerror}") from None
    except AssertionError as error:
        raise ConfigurationError(f"{file}: {error} is not made of keys and values") from None
    except (RuntimeError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{file}: {' '.join(str(error).split())}") from None
    return loaded
