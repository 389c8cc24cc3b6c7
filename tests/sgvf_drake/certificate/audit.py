"""The audit of models: whole fields over squares, held point by point against ball arithmetic.

It shares nothing with what it audits but the weights: neither the formulas of the models, nor
NumPy's functions, nor float64.
"""

from flint import arb
import numpy as np

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import dual_field, has_dual, model_field, model_score
from sgvf_drake.certificate.network_model import model_network

from .ball_fields import BallField
from .balls import dot, mixture_at, model_at

CORNERS = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
# Besides those: points on a side of the square, inside of it, and among how many of float64
# the worst are looked for.
ON_A_SIDE, INSIDE, TRIED = 4, 4, 200


def random_boxes(field, half, count, rng):
    """Squares of the grid of a half-side: half of them anywhere, half about the path."""
    anywhere = rng.uniform(-5, 5, (count - count // 2, 2))
    waypoints = field.cloud.normalize(field.cloud.points)
    about = waypoints[rng.integers(len(waypoints), size=count // 2)]
    about = about + field.sigma * rng.standard_normal(about.shape)
    centers = 2 * half * (np.floor(np.concatenate([anywhere, about]) / (2 * half)) + 0.5)
    return Boxes(centers, np.full(count, half))


def models_of(field, levels, boxes):
    """The models of an attempt at a proof, by what they stand for.

    The networks are among them: the slack of a composition would hide what they get wrong.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        gradient, m = levels.gradient(boxes), model_field(field, boxes)
        found = {
            "N": model_network(field.tangent_network, boxes),
            "S": model_score(field.score_model, boxes),
            "m": m,
            "grad V": gradient,
            "V": levels.level(boxes, gradient),
            "V_dot": gradient.dot(m),
        }
        if has_dual(field):
            found["div m"] = dual_field(field, boxes).divergence
    return found


def values_at(evaluated, levels, z):
    """The same at a point, in balls."""
    there = evaluated(z)
    V, gradient = mixture_at(levels.mixture, z)
    level = V - arb(levels.lowest)
    return {
        "N": there.N,
        "S": there.S,
        "m": there.m,
        "grad V": gradient,
        "V": [level],
        "V_dot": [dot(gradient, there.m)],
        "div m": [there.slopes[0][0] + there.slopes[1][1]],
    }


def adverse_steps(field, levels, boxes, models, row, rng):
    """Steps from the centre of a square that its models may not hold at, (k, 2)."""
    half = boxes.half[row]
    on_a_side = rng.uniform(-1, 1, (ON_A_SIDE, 2))
    on_a_side[np.arange(ON_A_SIDE), rng.integers(2, size=ON_A_SIDE)] = rng.choice(
        [-1, 1], ON_A_SIDE
    )
    tried = half * rng.uniform(-1, 1, (TRIED, 2))
    z = boxes.centers[row] + tried
    m = field(field.cloud.denormalize(z))
    gradient = -levels.mixture.score(z)
    values = {
        "N": field.tangent_network(z),
        "S": field.score_model.score(z),
        "m": m,
        "grad V": gradient,
        "V_dot": (gradient * m).sum(axis=1)[:, None],
    }
    worst = [
        np.abs(value - polynomial(models[name], row, tried)).argmax(axis=0)
        for name, value in values.items()
    ]
    inside = rng.uniform(-1, 1, (INSIDE, 2))
    fixed = half * np.concatenate([CORNERS, on_a_side, inside])
    return np.concatenate([fixed, tried[np.unique(np.concatenate(worst))]])


def polynomial(model, row, d):
    """The polynomials of a model's functions at steps (k, 2), in float64."""
    x, y = d.T[..., None]
    (linear_x, linear_y), q = model.jacobian[row], model.quadratic[row]
    linear = model.value[row] + linear_x * x + linear_y * y
    return linear + q[0] * x * x + q[1] * x * y + q[2] * y * y


def audit(field, levels, boxes, rng):
    """Holds the models over squares against balls, at adverse points of each.

    Returns:
        By what is audited: the number of values, of those that a model does not hold, and the
        largest part of a remainder that was used, which is to be below one.
    """
    models, evaluated = models_of(field, levels, boxes), BallField(field)
    found = {name: [0, 0, 0.0] for name in models}
    for row, center in enumerate(boxes.centers):
        for d in adverse_steps(field, levels, boxes, models, row, rng):
            z = [arb(float(c)) + arb(float(x)) for c, x in zip(center, d, strict=True)]
            values = values_at(evaluated, levels, z)
            for name, model in models.items():
                for column, value in enumerate(values[name]):
                    holds, used = held(model, row, column, d, value)
                    count, violated, largest = found[name]
                    found[name] = [count + 1, violated + (not holds), max(largest, used)]
    return found


def held(model, row, column, d, value):
    """Whether a model certainly holds a value, and which part of its remainder that takes."""
    expected, remainder = model_at(model, row, column, d)
    if not remainder.is_finite():
        # Over squares that are too large to say anything, models say so.
        return True, 0.0
    off = abs(value - expected)
    low, high = (arb(float(bound[row, column])) for bound in (model.lower, model.upper))
    return off <= remainder and low <= value <= high, float((off / remainder).upper())
