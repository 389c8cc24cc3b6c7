"""Names for the types of arrays; shapes stand in the docstrings."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""An array of float64, of a shape that the docstring tells."""

IntArray = NDArray[np.intp]
"""An array of indices."""

BoolArray = NDArray[np.bool_]
"""An array of truth values."""
