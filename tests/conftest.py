"""What several test packages share: fields, and experiments that take no time."""

from contextlib import contextmanager
import dataclasses
from dataclasses import dataclass
import json

from hypothesis import settings
import pytest

from sgvf_drake import plotting
from sgvf_drake.fields import load_field
from sgvf_drake.paths import make_shape
from tests.data.make import field_file, network_cloud, open_circle
from tests.fields import RECIPES, random_field, random_perceptron

# Machines are noisy: no test asserts a time, neither does one of hypothesis.
settings.register_profile("without a deadline", deadline=None)
settings.load_profile("without a deadline")


@pytest.fixture(scope="session", autouse=True)
def plain_pictures():
    """Draws coarsely, and few stream lines behind what a picture shows: both take time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plotting, "STREAM_DENSITY", 0.3)
        patch.setattr(plotting, "DPI", 60)
        yield


@pytest.fixture(scope="session")
def make_perceptron():
    """Makes random networks: (rng, inputs, hidden, outputs, num_frequencies=0)."""
    return random_perceptron


@pytest.fixture(scope="session")
def make_field():
    """Makes untrained fields; see `random_field`."""
    return random_field


@pytest.fixture(scope="session", params=RECIPES)
def field(request):
    """An untrained planar field of each recipe."""
    return random_field(request.param)


def stored_field_fixture(name):
    """A fixture that reads a trained field; see tests/data/make.py for what it learned."""

    @pytest.fixture(scope="session", name=f"{name}_field")
    def read():
        return load_field(field_file(name))

    return read


robust_field = stored_field_fixture("robust")
exact_field = stored_field_fixture("exact")
paper_field = stored_field_fixture("paper")
flight_field = stored_field_fixture("flight")
open_field = stored_field_fixture("open")
half_circle_field = stored_field_fixture("half_circle")


# Directed fields of a T, a bar of 6 m with a stem of 3 m below it, and of an eight, 6 m wide.
tee_field = stored_field_fixture("tee")
eight_field = stored_field_fixture("eight")


def directed_field(name):
    """An exact field of a network, trained anew; see `network_cloud`."""
    from sgvf_drake.learning import TrainingConfig, train

    config = TrainingConfig(recipe="exact", max_restarts=0)
    return train(network_cloud(name), config).field


@pytest.fixture(scope="session")
def concentric():
    """The headline cloud, 200 clean waypoints, and its true path."""
    return make_shape("concentric-circles")


@pytest.fixture(scope="session")
def open_cloud():
    """Six tenths of a circle of radius 3, from (-2.43, -1.76) around to (3, 0)."""
    return open_circle()


@dataclass(frozen=True)
class FakeTrial:
    seed: int
    size: int


MEASURED = []
"""The trials that `measure_fake` has measured."""


def measure_fake(trial, folder):
    MEASURED.append(trial)
    (folder / "note.txt").write_text(str(trial))
    if trial.size < 0:
        raise ValueError(f"the size cannot be {trial.size}")
    return {"square": trial.seed**2 * trial.size}


@dataclass
class FakeExperiment:
    """Draws, tabulates and claims in no time what its options say."""

    seeds: list[int] = dataclasses.field(default_factory=lambda: [0, 1])
    size: int = 3
    exhibit: str = "squares"
    verdict: str = "holds"
    statement: str = "Squares grow."
    of_paper: bool = True
    error: str = ""

    def measure(self, bench):
        # Imported here, as below: most tests do without them.
        import pandas as pd

        trials = [FakeTrial(seed, self.size) for seed in self.seeds]
        records = bench.run(measure_fake, trials, "squaring")
        if self.error:
            raise RuntimeError(self.error)
        return {"squares": pd.DataFrame([record.row for record in records])}

    def findings(self, rows):
        from sgvf_drake.paper.claims import Finding, Verdict

        told = self.statement, Verdict(self.verdict), "They do.", self.of_paper
        return [Finding("grow", "Section IX", *told)]

    def tables(self, rows):
        from sgvf_drake.paper.experiment import Exhibit

        name = f"{self.exhibit}_table"
        return [Exhibit(name, "The same in numbers.", rows["squares"])]

    def figures(self, rows):
        from matplotlib.figure import Figure

        from sgvf_drake.paper.experiment import Exhibit

        figure = Figure(figsize=(4, 3))
        figure.subplots().plot(rows["squares"]["square"])
        return [Exhibit(self.exhibit, "How squares grow.", figure)]

    def logs(self, rows):
        return {"log": rows["squares"]}


class FakeScenarios:
    """Stands in for the scenarios of the package."""

    kind = FakeExperiment
    measured = MEASURED

    def __init__(self, folder):
        self.folder = folder

    def write(self, name, quick="size: 1", **options):
        """Writes a scenario with these options, and an override `quick`."""
        values = {"size": 3, **options}
        path = self.folder / f"{name}.yaml"
        # JSON is YAML.
        path.write_text(
            f"scenario:\n"
            f"  title: Title of {name}\n"
            f"  source: Fig. 9\n"
            f"  experiment: !FakeExperiment {json.dumps(values)}\n"
            f"quick:\n"
            f"  experiment: !FakeExperiment {{{quick}}}\n"
        )
        return path


@contextmanager
def fake_scenarios_in(folder):
    """Has the scenarios of a folder in place of the package's; see `FakeScenarios.write`."""
    from sgvf_drake.paper import scenario

    MEASURED.clear()
    kinds = scenario.NoExperiment | FakeExperiment
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenario.Scenario.__dataclass_fields__["experiment"], "type", kinds)
        patch.setattr(scenario, "KINDS", (FakeExperiment,))
        patch.setattr(scenario, "_PACKAGED", folder)
        yield FakeScenarios(folder)


@pytest.fixture(scope="session")
def replace_scenarios():
    """Has other scenarios for a while; see `fake_scenarios_in`."""
    return fake_scenarios_in


@pytest.fixture
def fake_scenarios(tmp_path_factory):
    """Other scenarios for one test; see `FakeScenarios.write`."""
    with fake_scenarios_in(tmp_path_factory.mktemp("scenarios")) as scenarios:
        yield scenarios
