"""The audit of models: whole fields over patches, held point by point against ball arithmetic.

It shares nothing with what it audits but the weights: neither the formulas of the models, nor
NumPy's functions, nor float64.
"""

from flint import arb
import numpy as np

from sgvf_drake.certificate.field_model import (
    TAYLOR,
    direction_dual,
    direction_model,
    dual_field,
    has_dual,
    model_field,
)
from sgvf_drake.certificate.patches import Patches

from .ball_fields import BallField
from .balls import corners, dot, mixture_at, model_at, point_of

# Besides the corners: points on a side of the patch, inside of it, and among how many of
# float64 the worst are looked for.
ON_A_SIDE, INSIDE, TRIED = 4, 4, 200


def random_patches(field, half, k, count, rng):
    """Turned patches of k parameters: half of them anywhere, half about the path.

    Of those in the plane with two parameters every other one is a square of a grid.  More
    parameters than there are coordinates go anywhere, but less far, as the products of cells.
    """
    d = field.dim
    anywhere = rng.uniform(-5, 5, (count - count // 2, d))
    waypoints = field.cloud.normalize(field.cloud.points)
    about = waypoints[rng.integers(len(waypoints), size=count // 2)]
    about = about + 0.1 * rng.standard_normal(about.shape)
    centers = 2 * half * (np.floor(np.concatenate([anywhere, about]) / (2 * half)) + 0.5)
    axes = half * np.linalg.qr(rng.standard_normal((count, d, d)))[0][:, :, :k]
    axes *= rng.uniform(0.1, 1, (count, 1, min(k, d)))
    axes[::2] = half * np.eye(d, k)[:, :d]
    products = 0.3 * half * rng.uniform(-1, 1, (count, d, max(k - d, 0)))
    return Patches(centers, np.concatenate([axes, products], axis=2))


def models_of(field, levels, patches):
    """The models of an attempt at a proof, by what they stand for.

    The networks are among them: the slack of a composition would hide what they get wrong.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        m, (S, N) = model_field(field, patches), TAYLOR.score_and_tangent(field, patches)
        found = {"N": N, "S": S, "m": m, "direction": direction_model(field, patches)}
        if levels is not None:
            gradient = levels.gradient(patches)
            V = levels.level(patches, gradient)
            found |= {"grad V": gradient, "V": V, "V_dot": gradient.dot(m)}
        if has_dual(field):
            dual = dual_field(field, patches)
            found |= {"div m": dual.divergence}
            found |= {f"m by x_{i}": slope for i, slope in enumerate(dual.slopes)}
            slopes = direction_dual(field, patches).slopes
            found |= {f"direction by x_{i}": slope for i, slope in enumerate(slopes)}
    return found


def values_at(evaluated, levels, z):
    """The same at a point, in balls."""
    there = evaluated(z)
    slopes = there.slopes
    found = {"N": there.N, "S": there.S, "m": there.m, "direction": there.direction}
    found |= {"div m": [sum((row[i] for i, row in enumerate(slopes)), arb(0))]}
    found |= {f"m by x_{i}": row for i, row in enumerate(slopes)}
    found |= {f"direction by x_{i}": row for i, row in enumerate(there.direction_slopes)}
    if levels is not None:
        V, gradient = mixture_at(levels.mixture, z)
        level = V - arb(levels.lowest)
        found |= {"grad V": gradient, "V": [level], "V_dot": [dot(gradient, there.m)]}
    return found


def adverse_parameters(field, patches, model, row, rng):
    """Parameters at which the model of m over a patch may not hold, (n, k)."""
    k = patches.axes.shape[2]
    on_a_side = rng.uniform(-1, 1, (ON_A_SIDE, k))
    on_a_side[np.arange(ON_A_SIDE), rng.integers(k, size=ON_A_SIDE)] = rng.choice(
        [-1, 1], ON_A_SIDE
    )
    tried = rng.uniform(-1, 1, (TRIED, k))
    z = patches.centers[row] + tried @ patches.axes[row].T
    m = field(field.cloud.denormalize(z))
    worst = np.abs(m - polynomial(model, row, tried)).argmax(axis=0)
    inside = rng.uniform(-1, 1, (INSIDE, k))
    return np.concatenate([corners(k), on_a_side, inside, tried[np.unique(worst)]])


def polynomial(model, row, u):
    """The polynomials of a model's functions at parameters (n, k), in float64."""
    a, b = np.triu_indices(u.shape[1])
    monomials = np.column_stack([np.ones(len(u)), u, u[:, a] * u[:, b]])
    return monomials @ model.parts[row]


def audit(field, levels, patches, rng):
    """Holds the models over patches against balls, at adverse points of each.

    Returns:
        By what is audited: the number of values, of those that a model does not hold, and the
        largest part of a remainder that was used, which is to be below one.
    """
    models, evaluated = models_of(field, levels, patches), BallField(field)
    found = {name: [0, 0, 0.0] for name in models}
    for row in range(len(patches)):
        for u in adverse_parameters(field, patches, models["m"], row, rng):
            values = values_at(evaluated, levels, point_of(patches, u, row))
            for name, model in models.items():
                for column, value in enumerate(values[name]):
                    holds, used = held(model, row, column, u, value)
                    count, violated, largest = found[name]
                    found[name] = [count + 1, violated + (not holds), max(largest, used)]
    return found


def held(model, row, column, u, value):
    """Whether a model certainly holds a value, and which part of its remainder that takes."""
    expected, remainder = model_at(model, row, column, u)
    if not remainder.is_finite():
        # Over patches that are too large to say anything, models say so.
        return True, 0.0
    off = abs(value - expected)
    low, high = (arb(float(bound[row, column])) for bound in (model.lower, model.upper))
    return off <= remainder and low <= value <= high, float((off / remainder).upper())
