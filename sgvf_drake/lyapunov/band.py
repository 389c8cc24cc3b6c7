"""The band of levels on which V decreases along a field, and the noise level that suits it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.critical import critical_levels
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples
from sgvf_drake.lyapunov.scan import Scan
from sgvf_drake.lyapunov.sublevel import SublevelSet, sublevel_set
from sgvf_drake.paths import Reference
from sgvf_drake.progress import Progress, no_progress

# The noise levels of V that are tried, in those of the field.
SIGMA_RATIOS = (0.7, 1.0, 1.4, 2.0, 2.8)
# Bands with at least this share of the largest area are as good; of these, the thinnest tube.
NEARLY = 0.95
# Samples have gaps: a band keeps this distance from the levels where V was seen not to fall.
# The constant makes the thinnest tube a quarter of a noise level wide on each side.
LEVEL_MARGIN = 0.05
LEVEL_FLOOR = 0.03
# A band narrower than this (V is a logarithm) is an accident of the sampling.
MIN_BAND = 0.5
# A tube that reaches farther from the path than so many U does not lead along it.
MAX_HALF_WIDTH = 0.5


@dataclass(frozen=True, eq=False)
class Band:
    """Levels c_in <= V <= c_out on which V decreases, as far as it was sampled.

    Attributes:
        function: V.
        c_in: Its lower end; K = {V <= c_in} is the tube that the robot ends in.
        c_out: Its upper end.
        decrease: The smallest -V_dot that was found in the band, per unit of length.
        tube: K, on a raster.
        reference: The path.
        box: Lower and upper corner of the box, which {V <= c_out} does not touch.
    """

    function: LyapunovFunction
    c_in: float
    c_out: float
    decrease: float
    tube: SublevelSet
    reference: Reference
    box: tuple[FloatArray, FloatArray]

    @cached_property
    def basin(self) -> SublevelSet:
        """{V <= c_out}, from which robots come to the tube, on a raster."""
        return sublevel_set(self.function, self.c_out, self.reference, self.box)

    @property
    def area(self) -> float:
        """The area on which V decreases in the band."""
        return self.basin.area - self.tube.area


def search_band(
    field: GuidingField,
    samples: Samples,
    reference: Reference,
    ratios: Sequence[float] = SIGMA_RATIOS,
    seed: int = 0,
    stops: FloatArray | None = None,
    progress: Progress = no_progress,
) -> Band | None:
    """Returns a band with a large area and a thin tube, over several noise levels of V.

    Only bands whose tube is one ring around each closed piece and one strip along each open
    one count; None: there is none.

    Args:
        field: The field.
        samples: Its samples.
        reference: The path.
        ratios: The noise levels to try, in those of the field.
        seed: Of the search for worse points.
        stops: Where m vanishes, (k, 2): V falls on none of these levels; samples miss them.
        progress: Told how far it is.
    """
    bands = []
    for number, ratio in enumerate(ratios):
        function = LyapunovFunction.of(field, ratio * field.mixture.sigma)
        band = find_band(field, function, samples, reference, seed, stops)
        bands += [band] if band is not None else []
        progress("band", number + 1, len(ratios))
    largest = max((band.area for band in bands), default=0.0)
    large = [band for band in bands if band.area >= NEARLY * largest]
    return min(large, key=lambda band: band.tube.half_width, default=None)


def find_band(
    field: GuidingField,
    function: LyapunovFunction,
    samples: Samples,
    reference: Reference,
    seed: int = 0,
    stops: FloatArray | None = None,
) -> Band | None:
    """Returns the lowest band of levels on which V decreases; see `search_band`.

    The lowest, since past a critical level of V nothing follows for the tube below it.
    """
    rng = np.random.default_rng(seed)
    scan = Scan.of(field, function, samples)
    slope = np.linalg.norm(samples.as_grid(scan.gradient), axis=2)
    bad = np.append(scan.bad_levels, critical_levels(function, samples, slope))
    if stops is not None:
        bad = np.append(bad, function(stops))
    widest = MAX_HALF_WIDTH * field.cloud.unit_length
    lowest = 0.0
    while (gap := _first_gap(bad, scan.border_level, lowest)) is not None:
        V, V_dot = scan.climb(*gap, rng)
        worse = V[V_dot > -scan.min_decrease]
        if len(worse):
            bad = np.append(bad, worse)
            continue
        (c_in, c_out), box = gap, field.cloud.box
        tube = sublevel_set(function, c_in, reference, box)
        # A band without a sample says nothing.
        if len(V) and tube.follows(reference.closed) and tube.half_width <= widest:
            decrease = min(scan.smallest_decrease(c_in, c_out), -float(V_dot.max()))
            return Band(function, c_in, c_out, decrease, tube, reference, box)
        lowest = c_out
    return None


def _first_gap(bad: FloatArray, border: float, lowest: float) -> tuple[float, float] | None:
    """Returns the lowest band between bad levels, with its margins; None: there is none."""
    levels = np.sort(bad[bad < border])
    c_in = (1 + LEVEL_MARGIN) * np.append(0.0, levels) + LEVEL_FLOOR
    c_out = (1 - LEVEL_MARGIN) * np.append(levels, border)
    wide = np.flatnonzero((c_out - c_in >= MIN_BAND) & (c_in > lowest))
    return (float(c_in[wide[0]]), float(c_out[wide[0]])) if len(wide) else None
