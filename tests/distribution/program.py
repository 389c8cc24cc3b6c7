"""A user's program, for `mypy --strict`: `make wheel` checks it against the installed wheel.

Were one of the packages without types, `assert_type` would see `Any`, and the mistakes at the
end would go unnoticed, which makes their comments unused ones.
"""

from typing import assert_type

import numpy as np
from pydrake.systems.framework import DiagramBuilder

import sgvf_drake as sgvf
from sgvf_drake.learning import SelfCheck
from systems import AddGuidance, GuidanceLoop, QuadrotorParameters, SensorParameters

cloud = sgvf.PointCloud.read("waypoints.csv")
result = sgvf.train(cloud, sgvf.TrainingConfig(seed=0))
assert_type(result, sgvf.TrainingResult)
assert_type(result.self_check, SelfCheck)
assert_type(result.self_check.passed, bool)
assert_type(cloud.dim, int)

field = sgvf.load_field("field.safetensors")
velocity: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = field(cloud.points)

builder = DiagramBuilder()
plant = builder.AddNamedSystem("plant", QuadrotorParameters().MakePlant())
loop = AddGuidance(builder, field, plant, speed=0.45, sensors=SensorParameters())
assert_type(loop, GuidanceLoop)

sgvf.TrainingConfig(sede=0)  # type: ignore[call-arg]
AddGuidance(builder, field, plant, speed="fast")  # type: ignore[arg-type]
