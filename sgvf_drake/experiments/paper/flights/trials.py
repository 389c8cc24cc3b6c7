"""One flight of Fig. 3: a field is trained, and flown from piece to piece in one go."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sgvf_drake.exceptions import SgvfError
from sgvf_drake.experiments.tour import fly_tour
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.paths import make_shape
from systems import SensorParameters

FIELD, LOG = "field.safetensors", "flight.parquet"


@dataclass(frozen=True)
class FlightTrial:
    """A tour of the pieces of a shape.

    Attributes:
        shape: One of `SHAPES`, in metres.
        recipe: Of the training.
        seed: Of the cloud, the training and the noise of the measurements.
        tour: Numbers of the pieces, in the order of the flight.
        speed: Commanded speed, m/s.
        laps: Of each piece.
    """

    shape: str
    recipe: str
    seed: int
    tour: tuple[int, ...]
    speed: float
    laps: float


def measure_flight(trial: FlightTrial, folder: Path) -> Row:
    """Trains a field and flies it by noisy measurements; leaves the field and the log.

    A flight that loses control is a result as well: its row has the text of the error.
    """
    # Imported here: what was flown before is shown without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, path = make_shape(trial.shape, seed=trial.seed)
    settings: dict[str, Any] = {"recipe": trial.recipe, "seed": trial.seed}
    field = train(cloud, TrainingConfig(**settings)).field
    field.save(folder / FIELD)
    sensors = SensorParameters()
    try:
        result = fly_tour(
            field,
            path,
            trial.tour,
            speed=trial.speed,
            laps=trial.laps,
            sensors=sensors,
            seed=trial.seed,
        )
    except SgvfError as error:
        return {"error": str(error)}
    result.log.astype(np.float32).to_parquet(folder / LOG, index=False)
    return {
        "error": None,
        "completed": result.completed,
        "summary": result.summary(),
        "feasibility": asdict(result.feasibility),
        "real_time_factor": result.real_time_factor,
    }
