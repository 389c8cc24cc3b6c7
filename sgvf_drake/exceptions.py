"""The errors that this library raises on purpose, as one small tree, and its warnings.

Catch `SgvfError` to catch all of them.  Each one is also the built-in error that a
reader would expect, so ``except ValueError`` and ``except FileExistsError`` work too.
"""

from typing import Any


class SgvfError(Exception):
    """Base of every error that is raised on purpose by sgvf_drake and systems."""


class PointCloudError(SgvfError, ValueError):
    """The waypoints cannot be used: the message names the file, the line or the value."""


class FieldFileError(SgvfError, ValueError):
    """A field file is damaged, foreign, or of another version."""


class ConfigurationError(SgvfError, ValueError):
    """An option, a shape name or a parameter has a value that cannot be used."""


class LostControlError(ConfigurationError):
    """A vehicle lost control in a flight: what it was asked for is more than it can do.

    Attributes:
        log: That of the flight until then, a table.
    """

    log: Any = None


class OutputExistsError(SgvfError, FileExistsError):
    """Writing would replace a file; nothing was written."""


class NonFiniteValueError(SgvfError, ArithmeticError):
    """A system met a NaN or an infinity; the message names the system and the time."""


class ExperimentError(SgvfError):
    """Trials of an experiment failed; the others ran, and what they measured is stored."""


class InertiaWarning(UserWarning):
    """No rigid body has the inertia that was given; the nearest one is used."""
