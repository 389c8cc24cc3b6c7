"""Exported fields as they run: compiled by a C compiler, and called through ctypes."""

import ctypes
from pathlib import Path
import shutil
import subprocess

import numpy as np
import pytest

from sgvf_drake.export import export_c
from sgvf_drake.fields import DirectedField

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")

# What C has one at a time, for arrays of points; null where there is no direction.
LOOPS = """
#include "field.h"
#define DIM FIELD_DIM
#ifdef FIELD_MEMORY_LENGTH
#define G , g + i * DIM
#define FUNCTION(name) name##_g
#else
#define G
#define FUNCTION(name) name
#endif
void values(int n, const double *x, const double *g, double *m)
{
    (void)g;
    for (int i = 0; i < n; ++i)
        FUNCTION(field_value)(x + i * DIM G, m + i * DIM);
}
void jacobians(int n, const double *x, const double *g, double *J)
{
    (void)g;
    for (int i = 0; i < n; ++i)
        FUNCTION(field_jacobian)(x + i * DIM G, J + i * DIM * DIM);
}
void products(int n, const double *x, const double *g, const double *v, const double *w,
              double *jv)
{
    (void)g, (void)w;
    for (int i = 0; i < n; ++i)
#ifdef FIELD_MEMORY_LENGTH
        field_jvp_g(x + i * DIM, g + i * DIM, v + i * DIM, w ? w + i * DIM : w, jv + i * DIM);
#else
        field_jvp(x + i * DIM, v + i * DIM, jv + i * DIM);
#endif
}
#ifdef FIELD_MEMORY_LENGTH
void turns(int n, const double *x, const double *g, double *J)
{
    for (int i = 0; i < n; ++i)
        field_jacobian_by_direction(x + i * DIM, g + i * DIM, J + i * DIM * DIM);
}
void tangents(int n, const double *x, const double *g, double *t)
{
    for (int i = 0; i < n; ++i)
        field_tangent_g(x + i * DIM, g + i * DIM, t + i * DIM);
}
#endif
"""


def compiler():
    """The path of gcc; without it a test fails, and says what it needs."""
    found = shutil.which("gcc")
    if found is None:
        pytest.fail("these tests compile C, and there is no gcc: apt-get install gcc libc6-dev")
    return found


def compile_c(folder, *arguments, command=None):
    """Runs a compiler in a folder, every warning an error."""
    done = subprocess.run(
        [*(command or [compiler()]), *STRICT, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


class CField:
    """A field as C computes it, for arrays of points.

    Args:
        field: The field.
        folder: Where its code goes; one that has held none, since a library is loaded once.
        precision: As of `export_c`; and its other options.
        optimisation: Of the compiler.
        command: The compiler; gcc by default.
    """

    def __init__(
        self, field, folder, precision="mixed", optimisation="-O1", command=None, **options
    ):
        self.folder, self.dim = Path(folder), field.dim
        self.directed = isinstance(field, DirectedField)
        assert not self.folder.joinpath("field.so").exists()
        self.summary = export_c(field, folder, precision, **options)
        (self.folder / "loops.c").write_text(LOOPS)
        sources = ("field.c", "loops.c")
        arguments = (optimisation, "-shared", "-fPIC", *sources, "-lm", "-o", "field.so")
        compile_c(folder, *arguments, command=command)
        self.library = ctypes.CDLL(str(self.folder / "field.so"))

    def __call__(self, x, g=None):
        """As `Field.__call__` of a batch."""
        return self._call("values", x.shape, x, g)

    def jacobian(self, x, g=None):
        """dm/dx, (n, d, d)."""
        return self._call("jacobians", (*x.shape, self.dim), x, g)

    def product(self, x, v, g=None, w=None):
        """dm/dx v + dm/dg w, (n, d)."""
        return self._call("products", x.shape, x, g, v, w)

    def jacobian_by_direction(self, x, g):
        """dm/dg, (n, d, d)."""
        return self._call("turns", (*x.shape, self.dim), x, g)

    def tangent(self, x, g):
        """The direction of a strand, (n, d)."""
        return self._call("tangents", x.shape, x, g)

    def _call(self, name, shape, x, *others):
        arrays = [None if a is None else np.array(a, np.float64) for a in (x, *others)]
        result = np.empty(shape)
        pointers = [None if a is None else a.ctypes.data_as(ctypes.c_void_p) for a in arrays]
        getattr(self.library, name)(len(x), *pointers, result.ctypes.data_as(ctypes.c_void_p))
        return result
