"""Lyapunov analysis of guiding fields, by sampling; NumPy and SciPy only."""

from sgvf_drake.lyapunov.function import LyapunovFunction, find_modes

__all__ = ["LyapunovFunction", "find_modes"]
