"""The band of levels on which V decreases along a field, and the noise level that suits it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.vectors import component_along
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples
from sgvf_drake.lyapunov.sublevel import SublevelSet, sublevel_set
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

SIGMA_RATIOS = (0.7, 1.0, 1.4, 2.0, 2.8)
"""The noise levels of V that are tried, in those of the field."""

MIN_DECREASE = 0.01
"""V has to fall by more than this in every U of travel (at |m| = 1)."""

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
# So many samples on each of so many levels of a band are followed to worse places, by steps
# of half a noise level that shrink to a hundredth of it.
CLIMBERS = 20
CLIMB_LEVELS = 24
CLIMB_STEPS = 20
CLIMB_SHRINK = 0.82
# Newton steps from the smallest gradients of the grid to the critical points of V, where
# |grad V| sigma is below the second number; Hessians of a smaller determinant, times
# sigma^2d, are singular.
NEWTON_STEPS = 20
CRITICAL = 1e-6
SINGULAR = 1e-12


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
    reference: ReferencePath
    box: tuple[FloatArray, FloatArray]

    @cached_property
    def basin(self) -> SublevelSet:
        """{V <= c_out}, from which robots come to the tube, on a raster."""
        return sublevel_set(self.function, self.c_out, self.reference, self.box)

    @property
    def area(self) -> float:
        """The area on which V decreases in the band; in space the volume."""
        return self.basin.area - self.tube.area


def search_band(
    field: GuidingField,
    samples: Samples,
    reference: ReferencePath,
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
        stops: Where m vanishes, (k, d): V falls on none of these levels; samples miss them.
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
    reference: ReferencePath,
    seed: int = 0,
    stops: FloatArray | None = None,
) -> Band | None:
    """Returns the lowest band of levels on which V decreases; see `search_band`.

    The lowest, since past a critical level of V nothing follows for the tube below it.
    """
    rng = np.random.default_rng(seed)
    unit, box = field.cloud.unit_length, field.cloud.box
    V, gradient = function.value_and_gradient(samples.x)
    V_dot = (gradient * samples.m).sum(axis=1)
    outward = component_along(gradient, samples.m)
    slope = np.linalg.norm(samples.as_grid(gradient), axis=-1)
    bad = np.append(V[V_dot > -MIN_DECREASE / unit], critical_levels(function, samples, slope))
    if stops is not None:
        bad = np.append(bad, function(stops))
    border = _lowest_on_border(function, samples, V)
    lowest = 0.0
    while (gap := _first_gap(bad, border, lowest)) is not None:
        c_in, c_out = gap
        inside = np.flatnonzero((c_in <= V) & (c_out >= V))
        weak = inside[_weakest(V[inside], outward[inside], gap)]
        climbers = (samples.x[weak], V[weak], V_dot[weak], outward[weak])
        found_V, found_V_dot = _climb(field, function, climbers, gap, rng)
        worse = found_V[found_V_dot > -MIN_DECREASE / unit]
        if len(worse):
            bad = np.append(bad, worse)
            continue
        tube = sublevel_set(function, c_in, reference, box)
        # A band without a sample says nothing.
        thin = tube.half_width <= MAX_HALF_WIDTH * unit
        if len(weak) and tube.follows(reference.closed) and thin:
            decrease = -max(float(V_dot[inside].max()), float(found_V_dot.max()))
            return Band(function, c_in, c_out, decrease, tube, reference, box)
        lowest = c_out
    return None


def critical_levels(
    function: LyapunovFunction, samples: Samples, slope: FloatArray
) -> FloatArray:
    """Returns the levels of the critical points of V in the box, at which V_dot is zero.

    They are found by Newton's method from the local minima of the `slope` |grad V| on the grid
    of the samples, (ky, kx) or (kz, ky, kx); V falls fast so near to them that samples miss
    them.
    """
    lowest = slope == ndimage.minimum_filter(slope, size=3)
    x = samples.x[samples.on_grid][lowest.ravel()]
    for _ in range(NEWTON_STEPS):
        gradient, hessian = function.gradient_and_hessian(x)
        regular = np.abs(np.linalg.det(hessian)) > SINGULAR / function.sigma ** (
            2 * function.dim
        )
        x, gradient, hessian = x[regular], gradient[regular], hessian[regular]
        x = x - np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
    found = np.linalg.norm(function.gradient(x), axis=1) < CRITICAL / function.sigma
    lower, upper = samples.corners
    inside = ((lower <= x) & (x <= upper)).all(axis=1)
    return function(x[found & inside])


def _lowest_on_border(function: LyapunovFunction, samples: Samples, V: FloatArray) -> float:
    """Returns the lowest V on the border of the box, from V at the samples (n,)."""
    grid, axes = samples.as_grid(V), range(function.dim)
    lowest = min(grid.take(end, axis).min() for axis, end in product(axes, (0, -1)))
    if max(axis[1] - axis[0] for axis in samples.axes) > function.sigma:
        # Points of so coarse a grid lie around the lowest place, which is beside a waypoint.
        for axis, corner in product(axes, samples.corners):
            beside = function.mixture.points.copy()
            beside[:, axis] = corner[axis]
            lowest = min(lowest, function(beside).min())
    return float(lowest)


def _first_gap(bad: FloatArray, border: float, lowest: float) -> tuple[float, float] | None:
    """Returns the lowest band between bad levels, with its margins; None: there is none."""
    levels = np.sort(bad[bad < border])
    c_in = (1 + LEVEL_MARGIN) * np.append(0.0, levels) + LEVEL_FLOOR
    c_out = (1 - LEVEL_MARGIN) * np.append(levels, border)
    wide = np.flatnonzero((c_out - c_in >= MIN_BAND) & (c_in > lowest))
    return (float(c_in[wide[0]]), float(c_out[wide[0]])) if len(wide) else None


def _weakest(V: FloatArray, outward: FloatArray, gap: tuple[float, float]) -> IntArray:
    """Returns which points of a band have the smallest inward speed on levels all over it."""
    level = np.digitize(V, np.geomspace(*gap, CLIMB_LEVELS + 1)[1:-1])
    order = np.lexsort((-outward, level))
    # How many points of its level come before each.
    first = np.searchsorted(level[order], level[order])
    return np.asarray(order[np.arange(len(order)) - first < CLIMBERS])


def _climb(
    field: GuidingField,
    function: LyapunovFunction,
    climbers: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    gap: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Returns V and V_dot at points of a band where m flows in least, (k,) each.

    Points are pushed to where the inward normal speed is smaller still, by trial: what lies
    between the samples is to be found.  `climbers` are points (k, d), and there V, V_dot and
    the outward normal speed of m; `gap` the lowest and the highest level of the band.
    """
    x, V, V_dot, outward = climbers
    step = 0.5 * function.sigma
    for _ in range(CLIMB_STEPS):
        trial = x + step * rng.standard_normal(x.shape)
        trial_V, gradient = function.value_and_gradient(trial)
        m = field(trial)
        trial_outward = component_along(gradient, m)
        better = (trial_outward > outward) & (gap[0] <= trial_V) & (trial_V <= gap[1])
        x = np.where(better[:, None], trial, x)
        V = np.where(better, trial_V, V)
        V_dot = np.where(better, (gradient * m).sum(axis=1), V_dot)
        outward = np.where(better, trial_outward, outward)
        step *= CLIMB_SHRINK
    return V, V_dot
