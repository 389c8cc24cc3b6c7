"""A field with its certificate: the levels of V where a vehicle is, and what they tolerate."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import Certificate, Conditions
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.mixture_model import MixtureModel, mixture_of
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from systems import FieldForSpeed

CERTIFICATE = "certificate.json"
CERTIFICATE_FIGURE = "certificate.png"
# Points whose V is bounded at a time.
CHUNK = 1000


@dataclass(frozen=True, eq=False)
class CertifiedField:
    """A field, and what is proved of it.

    Attributes:
        field: In the unit of its waypoints; that of the certificate.
        certificate: Proves C1 on a band.
        scale: Metres in one unit of the waypoints, where it is flown.
    """

    field: GuidingField
    certificate: Certificate
    scale: float = 1.0

    @classmethod
    def open(
        cls, field: GuidingField, path: str | Path, speed: float, scale: float = 1.0
    ) -> "CertifiedField":
        """Reads the certificate of a field, or of it as it is flown at a speed.

        Args:
            field: In the unit of its waypoints.
            path: The file of the certificate, or the folder that `sgvf certify` left.
            speed: Of the flight, m/s.
            scale: Metres in one unit of the waypoints.

        Raises:
            ConfigurationError: If there is no certificate, if it is damaged or of another
                field, or if it proves nothing.
        """
        file = certificate_file(path)
        if file is None:
            raise ConfigurationError(f"there is no certificate in {path}")
        found = Certificate.load(file)
        if not found.levels:
            raise ConfigurationError(f"{file} proves nothing of levels of V: {found.reason}")
        for one in (field, as_flown(field, speed, scale)):
            if field_digest(one) == found.field_digest:
                return cls(one, found, scale)
        raise ConfigurationError(
            f"{file} is the certificate of another field: neither of this one nor of it as it "
            f"is flown at {speed:g} m/s"
        )

    @property
    def conditions(self) -> Conditions:
        """What is proved of the band of V; a certificate that proves something has them."""
        assert self.certificate.conditions is not None
        return self.certificate.conditions

    def V(self, x: FloatArray) -> FloatArray:  # noqa: N802
        """Returns V at most, (n,), at points (n, 2) in the unit of the waypoints."""
        sigma, lowest = self.conditions.sigma, self.conditions.lowest
        levels = MixtureModel(mixture_of(self.field, sigma), lowest)
        z = self.field.cloud.normalize(x)
        parts = np.array_split(z, len(z) // CHUNK + 1)
        return np.concatenate([levels.level_range(Boxes.points(part))[1] for part in parts])

    def e_star(self, V: FloatArray) -> FloatArray:
        """Returns what the levels of V tolerate, (n,), as a part of the speed.

        Below c_in, where nothing is proved of a level, it is that of the border of the tube;
        above c_out, where nothing is proved at all, it is zero.
        """
        levels = np.array(self.certificate.levels)
        e_star = np.array(self.certificate.e_star)
        number = np.searchsorted(levels, V, side="right") - 1
        return np.where(levels[-1] >= V, e_star[np.clip(number, 0, len(e_star) - 1)], 0.0)

    def error_and_margin(
        self, position: FloatArray, velocity: FloatArray, speed: float
    ) -> tuple[float, float]:
        """Returns the velocity error of a vehicle and what its level tolerates, of the speed.

        The error is infinite for a vehicle that is to stand still.

        Args:
            position: The first coordinates of p_WB, (2,) in m.
            velocity: Those of v_WB, (2,) in m/s.
            speed: Commanded speed, m/s.
        """
        x = position[None] / self.scale
        error = float(np.linalg.norm(velocity - speed * self.field(x)[0]))
        margin = float(self.e_star(self.V(x))[0])
        return error / speed if speed > 0.0 else np.inf, margin


def certificate_file(path: str | Path) -> Path | None:
    """Returns the file of a certificate from itself or its folder; None: it holds none."""
    path = Path(path)
    file = path / CERTIFICATE if path.is_dir() else path
    return file if file.is_file() else None


def as_flown(field: GuidingField, speed: float, scale: float = 1.0) -> GuidingField:
    """Returns what `systems.FieldForSpeed` makes of a field, in the unit of its waypoints.

    Args:
        field: In the unit of its waypoints.
        speed: Of the flight, m/s.
        scale: Metres in one unit of the waypoints.
    """
    metric = field.rescaled(scale)
    flown = FieldForSpeed(metric, speed)
    if flown is metric:
        return field
    assert isinstance(flown, GuidingField)
    return field.with_approach_length(flown.approach_length / scale)
