"""Bounds of plain networks over squares, beside the interval arithmetic of Arb.

Arb evaluates the network over the square as it stands (its natural extension), and by the mean
value theorem: the value at the centre, and bounds of the Jacobian over the square.
"""

from dataclasses import replace
from functools import partial
from itertools import product

from flint import arb
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import CHUNK, Boxes
from sgvf_drake.certificate.network_model import model_network
from sgvf_drake.fields import find_activation
from tests.fields import random_perceptron
from tests.sgvf_drake.certificate.ball_fields import BallNetwork

from .measuring import best_of

pytestmark = pytest.mark.benchmark

HALVES = (0.05, 0.02, 0.01)
# Squares that each is timed over, and points at which the network is sampled on each of them.
MANY, FEW, SAMPLES = 960, 60, 600
# Float64 evaluates the sampled values, to this of themselves.
ROUNDING = 1e-12


def by_models(network, boxes):
    parts = [boxes[start : start + CHUNK] for start in range(0, len(boxes), CHUNK)]
    models = [model_network(network, part.patches) for part in parts]
    return (
        np.concatenate([model.lower for model in models]),
        np.concatenate([model.upper for model in models]),
    )


def by_balls(network, boxes, *, centred):
    """The natural extension; or what it has in common with the mean value form."""
    balls = BallNetwork(network)
    bounds = []
    for center, half in zip(boxes.centers, boxes.half, strict=True):
        square = [arb(float(c), float(half)) for c in center]
        rows = balls(square)
        found = [row[0] for row in rows]
        if centred:
            step = arb(0, float(half))
            middle = balls([arb(float(c)) for c in center])
            found = [
                value.intersection(at[0] + slope_x * step + slope_y * step)
                for (value, slope_x, slope_y), at in zip(rows, middle, strict=True)
            ]
        bounds.append([[float(f.lower()), float(f.upper())] for f in found])
    return tuple(np.moveaxis(np.array(bounds), 2, 0))


METHODS = {
    "Taylor models": (MANY, by_models),
    "Arb, natural": (FEW, partial(by_balls, centred=False)),
    "Arb, mean value": (FEW, partial(by_balls, centred=True)),
}


def sampled(network, boxes, rng):
    """The smallest and the largest value at random points and in the corners."""
    corners = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    steps = np.concatenate([corners, rng.uniform(-1, 1, (SAMPLES, 2))])
    x = boxes.centers[:, None] + boxes.half[:, None, None] * steps
    values = network(x.reshape(-1, 2)).reshape(*x.shape)
    return values.min(axis=1), values.max(axis=1)


def compare(activation, half):
    rng = np.random.default_rng(1)
    network = random_perceptron(np.random.default_rng(0), 2, (64, 64), 2)
    network = replace(network, activation=find_activation(activation))
    boxes = Boxes(rng.uniform(-4, 4, (MANY, 2)), np.full(MANY, half))
    least, most = sampled(network, boxes, rng)
    rows, first = [], by_models(network, boxes)
    for name, (count, method) in METHODS.items():
        some = boxes[:count]
        ((low, high), *_), seconds = best_of(partial(method, network, some))
        width = (high - low) / (most - least)[:count]
        holds = (low <= least[:count] + ROUNDING) & (high >= most[:count] - ROUNDING)
        meets = (low <= first[1][:count]) & (high >= first[0][:count])
        rows.append(
            {
                "activation": activation,
                "half-side": half,
                "bounds": name,
                "width / sampled": np.median(width),
                "at 95 %": np.quantile(width, 0.95),
                "largest": width.max(),
                "squares / s": round(count / seconds),
                "hold": holds.mean(),
                "meet": meets.mean(),
            }
        )
    return rows


def test_bounds_beside_arb(save):
    cases = product(("SiLU", "Tanh"), HALVES)
    table = save([row for case in cases for row in compare(*case)], "bounds")
    assert (table[["hold", "meet"]] == 1).all(axis=None)
    median = table.set_index(["activation", "half-side", "bounds"])["width / sampled"].unstack()
    assert (median["Taylor models"] < median["Arb, mean value"]).all()
    assert (median["Arb, mean value"] < median["Arb, natural"]).all()
