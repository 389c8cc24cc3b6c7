"""A field with its certificate: the walls that hold a vehicle, and what they tolerate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.certificate import Certificate
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.composed import ScoreInducedField
from sgvf_drake.fields.storage import field_digest
from systems import FieldForSpeed

AnyField = TypeVar("AnyField", bound=ScoreInducedField)

CERTIFICATE = "certificate.json"
CERTIFICATE_FIGURE = "certificate.png"


@dataclass(frozen=True, eq=False)
class CertifiedField:
    """A field, and what is proved of it.

    Attributes:
        field: In the unit of its waypoints; that of the certificate.
        certificate: Proves walls around a piece or more.
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
                field, or if it proves no walls.
        """
        file = certificate_file(path)
        if file is None:
            raise ConfigurationError(f"there is no certificate in {path}")
        found = Certificate.load(file)
        if not any(found.walls):
            raise ConfigurationError(f"{file} proves nothing of walls: {found.reason}")
        for one in (field, as_flown(field, speed, scale)):
            if field_digest(one) == found.field_digest:
                return cls(one, found, scale)
        raise ConfigurationError(
            f"{file} is the certificate of another field: neither of this one nor of it as it "
            f"is flown at {speed:g} m/s"
        )

    def pairs_around(self, x: FloatArray) -> IntArray:
        """Returns how many pairs of walls hold points, (n, pieces), from the outermost.

        Only the walls of one piece hold a point.

        Args:
            x: (n, 2) in the unit of the waypoints.
        """
        z, none = self.field.cloud.normalize(x), np.zeros(len(x), int)
        return np.column_stack(
            [walls.count_around(z) if walls else none for walls in self.certificate.walls]
        )

    def e_star(self, pairs: IntArray) -> FloatArray:
        """Returns what the innermost walls that hold a point tolerate, of the speed, (n,).

        Where none do, nothing is proved, and it is zero.

        Args:
            pairs: (n, pieces) from `pairs_around`.
        """
        margins = [
            np.array([0.0, *piece.e_star[::-1]])[held]
            for piece, held in zip(self.certificate.pieces, pairs.T, strict=True)
        ]
        return np.asarray(np.max(margins, axis=0))

    def error_and_margin(
        self, position: FloatArray, velocity: FloatArray, speed: float
    ) -> tuple[float, float]:
        """Returns the velocity error of a vehicle and what its walls tolerate, of the speed.

        The error is infinite for a vehicle that is to stand still.

        Args:
            position: The first coordinates of p_WB, (2,) in m.
            velocity: Those of v_WB, (2,) in m/s.
            speed: Commanded speed, m/s.
        """
        x = position[None] / self.scale
        error = float(np.linalg.norm(velocity - speed * self.field(x)[0]))
        margin = float(self.e_star(self.pairs_around(x))[0])
        return error / speed if speed > 0.0 else np.inf, margin


def certificate_file(path: str | Path) -> Path | None:
    """Returns the file of a certificate from itself or its folder; None: it holds none."""
    path = Path(path)
    file = path / CERTIFICATE if path.is_dir() else path
    return file if file.is_file() else None


def as_flown(field: AnyField, speed: float, scale: float = 1.0) -> AnyField:
    """Returns what `systems.FieldForSpeed` makes of a field, in the unit of its waypoints.

    Args:
        field: In the unit of its waypoints.
        speed: Of the flight, m/s.
        scale: Metres in one unit of the waypoints.
    """
    metric: Any = field.rescaled(scale)
    flown = FieldForSpeed(metric, speed)
    if flown is metric:
        return field
    assert isinstance(flown, ScoreInducedField)
    return field.with_approach_length(flown.approach_length / scale)
