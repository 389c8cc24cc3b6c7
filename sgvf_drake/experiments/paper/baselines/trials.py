"""One method on one cloud: the field is built, followed, and measured like all others."""

from dataclasses import dataclass
from pathlib import Path
import time
import timeit

import numpy as np

from sgvf_drake.experiments.follow import PATIENCE, follow
from sgvf_drake.experiments.paper.baselines.measures import coverage, effort, errors, find_ways
from sgvf_drake.experiments.paper.baselines.methods import CASES, LEARNED, METHODS, make_case
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import ParametricField
from sgvf_drake.metrics import default_duration

# One point, so often in a row, and the best of so many rows.
EVALUATIONS, ROWS = 20, 7
TRAJECTORIES = "trajectories.npz"
# Every so many samples are kept for the figure: 0.2 U at full speed.
KEPT = 4


@dataclass(frozen=True)
class BaselineTrial:
    """A method on a case.

    Attributes:
        case: One of `CASES`.
        method: One of `METHODS`.
        seed: Of noise, order and training.
        starts: Number of starts.
    """

    case: str
    method: str
    seed: int
    starts: int


def measure_baseline(trial: BaselineTrial, folder: Path) -> Row:
    """Builds a field, follows it and measures it; leaves its trajectories.

    Returns:
        success, coverage, rms_u, max_u, effort (1/U), build_s (CPU, with the first
        evaluation), evaluation_us (one point); errors and effort are those of the agents
        that succeed, None without any.
    """
    cloud, reference = make_case(CASES[trial.case], trial.seed)
    if trial.method in LEARNED:
        import sgvf_drake.learning  # noqa: F401 (torch, before the time is taken)
    begin = time.process_time()
    field = METHODS[trial.method].build(cloud, trial.seed)
    point = cloud.points[0]
    state = field.lift(point[None])[0] if isinstance(field, ParametricField) else point
    field(state)
    build_s = time.process_time() - begin
    patience = PATIENCE.get(trial.method, 1.0)
    unit = cloud.unit_length
    run = follow(field, reference, trial.starts, patience * default_duration(reference, unit))
    ways = find_ways(run, reference, unit, patience)
    np.savez_compressed(
        folder / TRAJECTORIES,
        points=cloud.normalize(cloud.points),
        positions=cloud.normalize(run.positions[::KEPT]).astype(np.float32),
        good=ways.good,
    )
    seconds = timeit.repeat(lambda: field(state), number=EVALUATIONS, repeat=ROWS)
    return {
        "success": float(ways.good.mean()),
        "coverage": coverage(run, ways, cloud),
        **errors(run, ways, unit),
        "effort": effort(run, ways, unit),
        "build_s": build_s,
        "evaluation_us": 1e6 * min(seconds) / EVALUATIONS,
    }
