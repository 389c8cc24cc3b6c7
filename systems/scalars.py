"""What the systems share to work for float, for AutoDiffXd and in compiled code alike.

A law written with `Sqrt`, `Sin`, `Cos` and `Tanh` on plain scalars has one source for three
uses: marked with `compilable` it runs as it is on AutoDiffXd, and numba compiles it where
compiled code calls it.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import functools
import inspect
import math
import sys
from typing import Any

from numba.extending import overload, register_jitable
import numpy as np
import pydrake.autodiffutils
from pydrake.autodiffutils import AutoDiffXd
import pydrake.math
from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields.base import Field

Scalar = Any
"""float or AutoDiffXd; Python has no type that is either and closed under arithmetic."""

# Drake's stubs misname the type of every array, so its functions are used untyped.
_ad: Any = pydrake.autodiffutils

SCALARS = (float, AutoDiffXd)
"""The scalar types of every system here.  A learned field has no symbolic form."""

compilable = register_jitable
"""Marks a function of scalars and tuples that compiled code may call."""


def Sqrt(x: Any) -> Any:
    """Returns the square root."""
    return math.sqrt(x) if isinstance(x, float) else pydrake.math.sqrt(x)


def Sin(x: Any) -> Any:
    """Returns the sine of an angle in rad."""
    return math.sin(x) if isinstance(x, float) else pydrake.math.sin(x)


def Cos(x: Any) -> Any:
    """Returns the cosine of an angle in rad."""
    return math.cos(x) if isinstance(x, float) else pydrake.math.cos(x)


def Tanh(x: Any) -> Any:
    """Returns the hyperbolic tangent."""
    return math.tanh(x) if isinstance(x, float) else pydrake.math.tanh(x)


# Numba compares the names of the arguments: no annotations here.
overload(Sqrt)(lambda x: lambda x: math.sqrt(x))
overload(Sin)(lambda x: lambda x: math.sin(x))
overload(Cos)(lambda x: lambda x: math.cos(x))
overload(Tanh)(lambda x: lambda x: math.tanh(x))


def template(instantiate: Callable[[type], Any]) -> Any:
    """Makes a function from a scalar type to a system's class the template of that system.

    The class is a LeafSystem_[T] whose method `_construct` declares its ports and states.
    Drake's own constructor is called before it, and its arguments are remembered by name, as
    `_arguments`, for Drake's scalar conversion.
    """
    define: Any = TemplateSystem.define
    scope = sys.modules[instantiate.__module__]

    def instantiate_whole(T: type) -> Any:
        return _Whole(T, instantiate(T))

    def defined() -> Any:
        made = define(instantiate.__name__, T_list=SCALARS, scope=scope)(instantiate_whole)
        made.get_instantiation(float)
        return made

    # For each class, Drake reads the sources of all callers, of which a thread has few.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(defined).result()


def _Whole(T: type, system_class: Any) -> Any:
    """Gives a class what Drake asks of a template beside what its `_construct` declares."""
    declare = system_class._construct
    signature = inspect.signature(declare)

    @functools.wraps(declare)
    def Construct(self: Any, *args: Any, converter: Any = None, **kwargs: Any) -> None:
        LeafSystem_[T].__init__(self, converter=converter)
        declare(self, *args, **kwargs)
        self._arguments = signature.bind(self, *args, **kwargs).arguments
        del self._arguments["self"]

    def ConstructCopy(self: Any, other: Any, converter: Any = None) -> None:
        Construct(self, **other._arguments, converter=converter)

    system_class._construct, system_class._construct_copy = Construct, ConstructCopy
    return idle(system_class)


def idle(system_class: Any) -> Any:
    """Gives a class of Python systems, if it finds none, time derivatives that do nothing.

    Drake asks every system for its time derivatives in each stage of the integrator.  Where
    Python finds no method for it at all, as in Drake 1.58, it is searched anew each time, which
    costs a flight half of its speed.  Where it finds Drake's own, as in 1.51, this is
    remembered, and a method in Python would cost more than it saves.
    """
    if not hasattr(system_class, "DoCalcTimeDerivatives"):
        system_class.DoCalcTimeDerivatives = _DoNothing
    return system_class


def _DoNothing(self: Any, context: Any, derivatives: Any) -> None:
    pass


def MakeMoving(system: Any) -> None:
    """Gives one system of an `idle` class the time derivatives of `_CalcTimeDerivatives`."""
    kind: Any = type(system)
    system.__class__ = _MovingKind(kind)


@functools.cache
def _MovingKind(kind: Any) -> Any:
    return type(kind.__name__, (kind,), {"DoCalcTimeDerivatives": kind._CalcTimeDerivatives})


def ToFloat(value: Scalar) -> float:
    """Returns the value without its gradient."""
    return value.value() if isinstance(value, AutoDiffXd) else float(value)


def ToList(x: np.ndarray) -> list[float]:
    """Returns the values, without gradients, of a vector of either scalar type."""
    if x.dtype == object:
        return [v.value() for v in x.ravel()]
    return x.ravel().tolist()


def ToVector(T: type, values: Sequence[Scalar]) -> np.ndarray:
    """Returns an array of scalar type T from scalars, some of which may be plain floats."""
    if T is float:
        return np.array(values)
    return np.array([v if isinstance(v, AutoDiffXd) else AutoDiffXd(v) for v in values])


def Split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the values of an array of AutoDiffXd, and its gradient along a last axis.

    What only ever sees floats, as a network does, gets the values, and its derivatives push
    the gradient through by hand.  Running a network on objects takes 1,000 times longer.
    """
    column = x.reshape(-1, 1)
    gradient = _ad.ExtractGradient(column)
    values = _ad.ExtractValue(column).reshape(x.shape)
    return values, gradient.reshape(*x.shape, gradient.shape[1])


def Join(values: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Returns the array of AutoDiffXd that `Split` would take apart into these."""
    flat = gradient.reshape(values.size, -1) if gradient.size else np.zeros((values.size, 0))
    return _ad.InitializeAutoDiff(values.reshape(-1), flat).reshape(values.shape)


def EvalFieldValue(field: Field, x: np.ndarray) -> np.ndarray:
    """Returns m(x) of x's own shape, (d,) or (n, d), and scalar type; dm = J dx."""
    if x.dtype != object:
        return field(x)
    values, dx = Split(x)
    m, J = field.value_and_jacobian(values)
    return Join(m, J @ dx)


def EvalField(field: Field, x: np.ndarray) -> np.ndarray:
    """Returns m(x) and J(x) by rows, (d + d^2,), in the scalar type of x (d,); dJ = H dx."""
    if x.dtype != object:
        m, J = field.value_and_jacobian(x)
        return np.concatenate((m, J.ravel()))
    values, dx = Split(x)
    m, J = field.value_and_jacobian(values)
    # A gradient of size zero is a constant: it needs no Hessian.
    dJ = field.hessian(values) @ dx if dx.size else np.zeros((*J.shape, 0))
    return np.concatenate((Join(m, J @ dx), Join(J, dJ).ravel()))


def CheckFiniteParameter(name: str, value: Scalar) -> None:
    """Raises ConfigurationError unless the parameter is finite."""
    if not math.isfinite(ToFloat(value)):
        raise ConfigurationError(f"{name} must be finite, got {value}")


def CheckPositiveParameter(name: str, value: Scalar) -> None:
    """Raises ConfigurationError unless the parameter is finite and positive."""
    if not (math.isfinite(ToFloat(value)) and value > 0.0):
        raise ConfigurationError(f"{name} must be finite and positive, got {value}")


def CheckNonNegativeParameter(name: str, value: Scalar) -> None:
    """Raises ConfigurationError unless the parameter is finite and not negative."""
    if not (math.isfinite(ToFloat(value)) and value >= 0.0):
        raise ConfigurationError(f"{name} must be finite and not negative, got {value}")


def CheckConstant(name: str, value: Scalar) -> float:
    """Returns the value of a parameter that nothing can be differentiated by.

    Raises:
        ConfigurationError: if it has a gradient that is not zero.
    """
    if isinstance(value, AutoDiffXd) and value.derivatives().any():
        raise ConfigurationError(f"there is no derivative by {name}")
    return ToFloat(value)


def CheckFinite(system: Any, context: Any, quantity: Any, values: Sequence[float]) -> None:
    """Raises NonFiniteValueError, with the system and the time, on a NaN or an infinity.

    A NaN makes Drake's error-controlled integrators shrink their step for ever, so it must
    not leave a system.

    Args:
        system: The system that met the value.
        context: Its Context, for the time.
        quantity: What holds the value: an input port, or words for the message.
        values: Plain floats; see `ToList`.
    """
    # One sum instead of a test for each value: this runs on every sample.
    if math.isfinite(sum(values)) or all(map(math.isfinite, values)):
        return
    if not isinstance(quantity, str):
        quantity = f"input port '{quantity.get_name()}'"
    name = system.GetSystemPathname() if system.get_name() else type(system).__name__
    raise NonFiniteValueError(
        f"{name}: {quantity} is not finite at t = {ToFloat(context.get_time()):.6g} s: {values}"
    )


def CheckFiniteAgents(system: Any, context: Any, quantity: str, values: np.ndarray) -> None:
    """Raises NonFiniteValueError, naming the first agent with a NaN or an infinity.

    Args:
        system: The system that met the values.
        context: Its Context, for the time.
        quantity: What the values are, for the message: "the position".
        values: One row an agent, (n, ...), of either scalar type.
    """
    floats = np.array(ToList(values)).reshape(len(values), -1)
    if np.isfinite(floats).all():
        return
    agent = int(np.flatnonzero(~np.isfinite(floats).all(axis=1))[0])
    CheckFinite(system, context, f"{quantity} of agent {agent}", floats[agent].tolist())
