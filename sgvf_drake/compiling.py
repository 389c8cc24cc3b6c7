"""How numba is asked to compile: the parts of a kernel, and the kernel that is cached."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import hashlib
import inspect
from types import ModuleType
from typing import Any

from numba import njit
from numba.core import event

part = njit(error_model="numpy")
"""Marks a function that kernels call.  It divides by zero as NumPy does, and is not cached."""

accumulating_part = njit(error_model="numpy", fastmath={"contract"})
"""The same for sums of products, which may be fused: a quarter faster, no less exact."""


def kernel(function: Callable[..., Any]) -> Any:
    """Compiles a function on its first call, or takes it from numba's cache on disk.

    The cache is the package's `__pycache__`, or else in the user's cache folder.  Where
    neither can be written, the function is compiled in every process.  See `digest` for what
    the function has to enclose.
    """
    try:
        return njit(cache=True, error_model="numpy")(function)
    except RuntimeError:
        # No folder to cache it in.
        return part(function)


def digest(*modules: ModuleType) -> int:
    """Returns a number that changes with the sources of modules.

    numba's cache only looks at the file of the kernel itself, and keeps what it has compiled
    from others when they change.  But a variable that the kernel encloses is a part of its
    key there: so kernels enclose this.
    """
    sources = "".join(inspect.getsource(module) for module in modules)
    return int.from_bytes(hashlib.sha256(sources.encode()).digest()[:6])


@contextmanager
def announced(tell: Callable[[], None]) -> Iterator[None]:
    """Calls `tell` where something is compiled inside, before it is: on the first run only.

    What numba has in its cache on disk is not compiled again.
    """

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            tell()

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield
