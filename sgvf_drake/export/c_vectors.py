"""Test vectors: points, what a field is there, and what its automata do on walks."""

from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.export.c_numbers import CArray
from sgvf_drake.fields import ComposedField, DirectedField
from sgvf_drake.paths.navigator import Navigator

SEED = 0
IN_BOX, BESIDE, ON_WAYPOINTS, FAR = 24, 12, 4, 4
"""How many points are where."""

FAR_BOXES = 10.0
"""Points far away are so many boxes away."""

TOLERANCES = {"double": 1e-10, "mixed": 1e-10, "float": 1e-3}
"""By precision, relative to the largest number beyond 1."""

STEP, WANDERING = 0.5, 0.3
"""A walk along a route goes on by so many sigma a step, and is off the line by as much as the
second, a standard deviation."""

MAX_STEPS = 1000


def points_for(field: ComposedField | DirectedField) -> FloatArray:
    """Returns points (n, d): over the box, beside waypoints and on them, far away, at ends."""
    rng, cloud = np.random.default_rng(SEED), field.cloud
    low, high = cloud.box
    box = rng.uniform(low, high, (IN_BOX, cloud.dim))
    near = cloud.points[rng.integers(cloud.num_points, size=BESIDE + ON_WAYPOINTS)]
    near[:BESIDE] += field.sigma * cloud.unit_length * rng.standard_normal((BESIDE, cloud.dim))
    away = rng.standard_normal((FAR, cloud.dim))
    away *= FAR_BOXES * (high - low).max() / np.linalg.norm(away, axis=1, keepdims=True)
    return np.concatenate([box, near, cloud.center + away, field.ends])


def vectors_of(field: ComposedField | DirectedField) -> list[CArray]:
    """Returns the arrays of a comparison, by the names of the template."""
    x = points_for(field)
    rng = np.random.default_rng(SEED + 1)
    v = rng.standard_normal(x.shape)
    if not isinstance(field, DirectedField):
        m, J = field.value_and_jacobian(x)
        named = {"values": m, "jacobians": J, "products": np.einsum("nij,nj->ni", J, v)}
        return _arrays(points=x, velocities=v, **named)
    g, w = rng.standard_normal((2, *x.shape))
    g /= np.linalg.norm(g, axis=1, keepdims=True)
    m, J = field.value_and_jacobian(x, g)
    by_g = field.jacobian_by_direction(x, g)
    products = np.einsum("nij,nj->ni", J, v) + np.einsum("nij,nj->ni", by_g, w)
    return _arrays(
        points=x,
        velocities=v,
        directions=g,
        turns=w,
        values=m,
        jacobians=J,
        by_direction=by_g,
        products=products,
        tangents=field.tangent(x, g),
    )


def walk_of(
    number: int, navigator: Navigator, sigma: float
) -> tuple[dict[str, Any], list[CArray]]:
    """Returns a walk along a route, as positions and the sections that the automaton is in."""
    itinerary = navigator.itinerary
    rng = np.random.default_rng([SEED, number])
    # Over the start of a closed route too.
    length = itinerary.length * (1.1 if itinerary.closed else 1.0)
    arcs = np.arange(0.0, length, max(STEP * sigma, length / MAX_STEPS))
    on_line = itinerary.line.at(arcs % itinerary.length if itinerary.closed else arcs)
    x = on_line + WANDERING * sigma * rng.standard_normal(on_line.shape)
    state = navigator.start(x[:1])
    sections = []
    for point in x:
        state = navigator.advance(state, point[None])
        sections.append(int(state.section[0]))
    arrays = [
        CArray(f"walk_{number}", "double", x),
        CArray(f"sections_{number}", "long", np.array(sections)),
    ]
    return {"count": len(x)}, arrays


def _arrays(**values: FloatArray) -> list[CArray]:
    return [CArray(name, "double", array) for name, array in values.items()]
