"""Where a robot that remembers its heading goes round a tip, and where it comes to rest."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.fields import RobustComposition, StrandMixture
from sgvf_drake.learning.support import tangents_at
from sgvf_drake.paths import Piece

SIGMA = 0.1
LEG = 2.0


def way_behind(degrees, one_way, at_node):
    """How far on the leg behind a tip of an angle a robot is after a way of twice a leg."""
    angle = np.pi - np.radians(degrees)
    behind = np.array([np.cos(angle), np.sin(angle)])
    line = Piece(np.array([[-LEG, 0.0], [0.0, 0.0], 2 * LEG * behind]), closed=False)
    arc = SIGMA / 2 * (np.arange(round(6 * LEG / SIGMA)) + 0.5)
    directions = tangents_at(line, arc, SIGMA)
    if at_node:  # Two edges meet there, whose chords end at it.
        directions = np.where(arc[:, None] < LEG, [1.0, 0.0], behind)
    mixture = StrandMixture(line.at(arc), directions, np.full(len(arc), one_way), SIGMA)
    composition = RobustComposition(2 * SIGMA, SIGMA)

    def motion(_, state):
        x, h = state[None, :2], state[None, 2:]
        S, N = mixture(x, h)
        turn = (composition.tangent(N) - h) / SIGMA
        return np.concatenate([composition.value(S, N), turn], axis=1)[0]

    start = [-LEG + 5 * SIGMA, 0.0, 1.0, 0.0]
    end = solve_ivp(motion, (0, 2 * LEG), start, rtol=1e-5, max_step=SIGMA / 2).y[:2, -1]
    return end @ behind


@pytest.mark.parametrize(
    ("one_way", "at_node", "passed", "rested"),
    [(False, True, 95, 88), (False, False, 52, 42), (True, False, 32, 22)],
)
def test_the_sharpest_tip_that_is_driven_round(one_way, at_node, passed, rested):
    assert way_behind(passed, one_way, at_node) > LEG / 2
    assert way_behind(rested, one_way, at_node) < SIGMA
