"""How large the responses of a small linear system are, proved: peaks and integrals.

Of x' = A x + B u with a stable A, the output c . x is at most the peak of its free response
plus the integral of |c exp(A t) B| times the largest |u|.  With vectors in place of numbers,
and the same A for each of their coordinates, this holds of their lengths.
"""

from dataclasses import dataclass
from fractions import Fraction
import math

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from sgvf_drake.arrays import FloatArray

# Steps of a response, in parts of the time constant of A, and how far it is followed, in times
# at which what is left has shrunk by 1 / e.
STEPS, TIMES = 400.0, 40.0
# Steps that are taken at once.
BLOCK = 512
# Terms of the exponential of a step: (1 / 400)^9 / 9! is far below rounding.
TERMS = 9
# Above what some ten thousand steps of products with a matrix are off by, relative to their
# norms in P, in which every step shrinks.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Responses:
    """Bounds of the responses of outputs c_o to each start and each input.

    Attributes:
        integral: (o, i) of |c_o exp(A t) B_i| over t >= 0.
        peak: (o, n) of |c_o exp(A t)| at t >= 0, for each state that starts at one.
        late: The same at t >= `settling`.
        settling: A time, s.
    """

    integral: FloatArray
    peak: FloatArray
    late: FloatArray
    settling: float


def respond(
    A: FloatArray, B: FloatArray, outputs: FloatArray, settling: float
) -> Responses | None:
    """Bounds responses; None: it is not proved that A is stable.

    Between two steps h apart a response is off the line between its ends by h^2 / 8 of its
    second derivative c A^2 exp(A t) B at most, and that by the norm of P, which shrinks.

    Args:
        A: (n, n).
        B: (n, i) the inputs.
        outputs: (o, n) the outputs c.
        settling: See the attribute.
    """
    found = _shrinking(A)
    if found is None:
        return None
    P, alpha = found
    h = 1 / (STEPS * float(np.linalg.norm(A, 2)) / 20)
    step = _exponential(A * h)
    # |c . x| <= size |x|_P.
    inverse = np.linalg.inv(P)
    size, bent = (
        np.sqrt(np.einsum("oi,ij,oj->o", rows, inverse, rows)) * (1 + ROUNDING)
        for rows in (outputs, outputs @ A @ A)
    )
    n = len(A)
    state = np.concatenate([np.eye(n), B], axis=1)
    start = _norms(P, state)
    count = math.ceil(TIMES / alpha / h / BLOCK)
    powers = [np.eye(n)]
    for _ in range(BLOCK):
        powers.append(step @ powers[-1])
    total = np.zeros((len(outputs), state.shape[1]))
    peak, late = np.zeros((len(outputs), n)), np.zeros((len(outputs), n))
    norm = start
    for block in range(count):
        states = np.stack(powers) @ state
        values = np.abs(outputs @ states)
        norms = _norms(P, states)[:-1, None]
        off = h**2 / 8 * bent[:, None] * norms + ROUNDING * size[:, None] * start
        total += h * ((values[:-1] + values[1:]) / 2 + off).sum(axis=0)
        most = (np.maximum(values[:-1], values[1:]) + off)[:, :, :n]
        peak = np.maximum(peak, most.max(axis=0))
        after = (block * BLOCK + np.arange(1, BLOCK + 1)) * h >= settling
        late = np.maximum(late, most[after].max(axis=0, initial=0.0))
        state = states[-1]
        norm = _norms(P, state)
    left = size[:, None] * (norm + ROUNDING * start)
    total += left / alpha
    peak, late = (np.maximum(one, left[:, :n]) for one in (peak, late))
    grown = 1 + ROUNDING
    return Responses(grown * total[:, n:], grown * peak, grown * late, settling)


def _norms(P: FloatArray, columns: FloatArray) -> FloatArray:
    """Returns the norms in P of the columns of matrices (..., n, c), (..., c)."""
    square = np.maximum((columns * (P @ columns)).sum(axis=-2), 0)
    return np.asarray(np.sqrt(square) * (1 + ROUNDING))


def _exponential(A: FloatArray) -> FloatArray:
    """Returns exp(A) of a small matrix, by its series."""
    total = term = np.eye(len(A))
    for number in range(1, TERMS + 1):
        term = term @ A / number
        total = total + term
    return total


def _shrinking(A: FloatArray) -> tuple[FloatArray, float] | None:
    """Returns P and alpha with A'P + PA + 2 alpha P < 0, decided in rational arithmetic."""
    slowest = float(-np.linalg.eigvals(A).real.max())
    if not slowest > 0:
        return None
    alpha = 0.8 * slowest
    shifted = A + 0.9 * slowest * np.eye(len(A))
    P = solve_continuous_lyapunov(shifted.T, -np.eye(len(A)))
    P = (P + P.T) / 2
    exact = [[Fraction(x) for x in row] for row in P.tolist()]
    dynamics = [[Fraction(x) for x in row] for row in A.tolist()]
    n = len(A)
    PA = [
        [sum((exact[i][m] * dynamics[m][j] for m in range(n)), Fraction(0)) for j in range(n)]
        for i in range(n)
    ]
    decay = [
        [-PA[i][j] - PA[j][i] - 2 * Fraction(alpha) * exact[i][j] for j in range(n)]
        for i in range(n)
    ]
    return (P, alpha) if _positive(exact) and _positive(decay) else None


def _positive(M: list[list[Fraction]]) -> bool:
    """Whether a symmetric matrix of rational numbers is positive definite, by elimination."""
    rows = [list(row) for row in M]
    for i in range(len(rows)):
        if rows[i][i] <= 0:
            return False
        for j in range(i + 1, len(rows)):
            factor = rows[j][i] / rows[i][i]
            rows[j] = [x - factor * y for x, y in zip(rows[j], rows[i], strict=True)]
    return True
