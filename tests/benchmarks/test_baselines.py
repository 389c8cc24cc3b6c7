"""What a field costs, classical or learned: time to build it, and time of one value.

Run by `make bench`; the table is printed and saved in build/bench.
"""

from collections.abc import Callable
import time
import timeit

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.fields import GuidingField, ParametricField
import sgvf_drake.learning  # noqa: F401 (torch, before the times are taken)
from sgvf_drake.paper.methods import CASES, METHODS, make_case

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
EVALUATIONS, ROWS = 200, 5
BATCH = 1_000


def microseconds(call: Callable[[], object], number: int = EVALUATIONS) -> float:
    return 1e6 * min(timeit.repeat(call, number=number, repeat=ROWS)) / number


def test_time_to_build_and_time_of_a_value(save: Save) -> None:
    """All on the ordered waypoints of one smooth curve."""
    cloud, _ = make_case(CASES["ordered"], 0)
    rng = np.random.default_rng(0)
    x = rng.uniform(*cloud.box, (BATCH, 2))
    rows = []
    for name, method in METHODS.items():
        begin = time.process_time()
        field = method.build(cloud, 0)
        states = field.lift(x) if isinstance(field, ParametricField) else x
        field(states[0])
        build_s = time.process_time() - begin
        one = microseconds(lambda: field(states[0]))  # noqa: B023 (called at once)
        with_jacobian = microseconds(lambda: field.value_and_jacobian(states[0]))  # noqa: B023
        many = microseconds(lambda: field(states), 3) / BATCH  # noqa: B023
        compiled = np.nan
        if isinstance(field, GuidingField):
            evaluate = field.compiled().evaluate
            np.testing.assert_allclose(evaluate(states[0])[:2], field(states[0]), atol=1e-9)
            compiled = microseconds(lambda: evaluate(states[0]))  # noqa: B023
        rows.append(
            {
                "method": method.label,
                "build_s": build_s,
                "value_us": one,
                "value_and_jacobian_us": with_jacobian,
                "of_a_thousand_us": many,
                "compiled_us": compiled,
            }
        )
        assert np.isfinite(field(states)).all(), name
    save(pd.DataFrame(rows), "baselines")
