"""What is measured of a trained field, and what counts as falling short."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.experiments.follow import FollowResult
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.vectors import cosine, curl_share
from sgvf_drake.paths import ReferencePath

# Where the learned score is compared with the exact one: distances from the path, U.
NEAR_PATH = (0.03, 0.3)
# Points drawn there (some land outside), and points on the path; the percentiles of more
# agree with these to the digits that are printed.
NEAR_SAMPLES = 1_500
PATH_SAMPLES = 200
LOW_PERCENTILE = 0.05

# What every start has to do; a path without closed (open) pieces has no laps (ends).
WANTED = {"reach": 1.0, "lap": 1.0, "end": 1.0, "stall": 0.0, "leave": 0.0}

Row = dict[str, Any]


def following(run: FollowResult, unit_length: float) -> Row:
    """Returns the fractions of `WANTED`, cross-track errors in U, and speeds on the path."""
    summary = run.summary()

    def in_units(key: str) -> float | None:
        value = summary[key]
        return None if value is None else value / unit_length

    fractions = {name: summary.get(f"{name}_fraction") for name in WANTED}
    return {
        **fractions,
        "rms_u": in_units("cross_track_rms"),
        "max_u": in_units("cross_track_max"),
        "speed_min": summary["speed_on_path_min"],
        "speed_max": summary["speed_on_path_max"],
    }


def measure_score(field: GuidingField, reference: ReferencePath, seed: int) -> Row:
    """Compares the learned score with that of the field's `mixture`, near its true path.

    Returns:
        score_cosine, score_cosine_p5: mean and 5th percentile of the cosine between the
            scores, at distances `NEAR_PATH`.
        score_bias_u: the error of the score, averaged over a small circle about a point of
            the path, times sigma^2: how far it moves the path, U; mean over the path.
        score_curl: median of the antisymmetric over the whole part of the score's Jacobian
            (in the plane |dSx/dy - dSy/dx| / |J|); a true gradient has none.
        orthogonality: mean |cosine| between score and tangent.
    """
    rng = np.random.default_rng(seed)
    oracle = field.mixture
    x = _near_path(field, reference, rng)
    S = field.score(x)
    agreement = cosine(S, oracle.score(x))
    J = field.score_model.score_and_jacobian(field.cloud.normalize(x))[1]
    return {
        "score_cosine": float(agreement.mean()),
        "score_cosine_p5": float(np.quantile(agreement, LOW_PERCENTILE)),
        "score_bias_u": _bias(field, reference),
        "score_curl": float(np.median(curl_share(J))),
        "orthogonality": float(np.abs(cosine(S, field.tangent(x))).mean()),
    }


def _near_path(
    field: GuidingField, reference: ReferencePath, rng: np.random.Generator
) -> FloatArray:
    near, far = (bound * field.cloud.unit_length for bound in NEAR_PATH)
    points = _on_path(reference, NEAR_SAMPLES)
    away = rng.standard_normal(points.shape)
    away *= rng.uniform(near, far, (len(away), 1)) / np.linalg.norm(away, axis=1)[:, None]
    x = points + away
    distance = reference.project(x).distance
    return x[(near <= distance) & (distance <= far)]


def _bias(field: GuidingField, reference: ReferencePath) -> float:
    unit, dim = field.cloud.unit_length, field.dim
    circle = NEAR_PATH[0] * unit * np.concatenate([np.eye(dim), -np.eye(dim)])
    x = (_on_path(reference, PATH_SAMPLES)[:, None] + circle).reshape(-1, dim)
    error = field.score(x) - field.mixture.score(x)
    mean = error.reshape(-1, len(circle), dim).mean(axis=1)
    return float(np.linalg.norm(mean, axis=1).mean() * field.sigma**2 * unit)


def _on_path(reference: ReferencePath, count: int) -> FloatArray:
    """Returns about `count` points (n, d) at equal steps of arc length."""
    shares = np.ceil(count * reference.lengths / reference.lengths.sum()).astype(int)
    pairs = zip(reference.pieces, shares, strict=True)
    return np.concatenate([piece.sample(int(share)) for piece, share in pairs])


def failure(row: Mapping[str, Any]) -> str | None:
    """Returns what a row falls short in, in words; None where it does not."""
    parts = [
        f"{name} {row[name]:.1%}"
        for name, wanted in WANTED.items()
        if row[name] is not None and row[name] != wanted
    ]
    if not row["self_check_passed"]:
        parts.append(f"self-check: {row['self_check_message']}")
    elif parts:
        parts.append("self-check passed")
    return ", ".join(parts) or None
