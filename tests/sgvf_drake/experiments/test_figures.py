"""The figures of the commands, and the table of trajectories."""

from dataclasses import replace

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest

from sgvf_drake import plotting
from sgvf_drake.experiments import fly_tour
from sgvf_drake.experiments.figures import runs as figures


@pytest.fixture
def check_picture(tmp_path):
    """Saves a figure, of which something but not everything is drawn."""

    def check(figure):
        figure.savefig(tmp_path / "a.png")
        drawn = np.any(imread(tmp_path / "a.png")[..., :3] < 0.9, axis=2)
        assert min(drawn.shape) > 300
        assert 0.005 < drawn.mean() < 0.9
        # Every quarter of it holds something: no panel stayed empty.
        for half in np.array_split(drawn, 2):
            for quarter in np.array_split(half, 2, axis=1):
                assert quarter.mean() > 0.002

    return check


def test_figures_of_training_following_and_flying(check_picture, flight_field, followed, flown):
    losses = {"iteration": [1, 2, 3], "total": [3.0, 2.0, 1.0], "fit": [3.0, 2.0, 1.0]}
    history = pd.DataFrame({"stage": "tangent", **losses})
    figure = figures.training_figure(flight_field, history)
    assert len(figure.axes) == 2
    check_picture(figure)
    check_picture(figures.follow_figure(flight_field, followed))
    flight = flown.fast.flights[0]
    check_picture(figures.flight_figure(flight_field, flight_field.cloud, flight, flown.fast))


def test_tour_figure(check_picture, flight_field, rings):
    tour = fly_tour(flight_field, rings, (0, 1), speed=2.0)
    figure = figures.tour_figure(flight_field, flight_field.cloud, tour)
    plane, *timelines = figure.axes
    assert "pieces 1, 2" in plane.get_title()
    (transfer,) = tour.transfers
    # The transfer is drawn, and shaded over time.
    away = plane.get_lines()[-1].get_ydata()
    assert 0 < np.isfinite(away).sum() < len(tour.log)
    for timeline in timelines:
        (shade,) = timeline.collections
        begin, end = shade.get_datalim(timeline.transData).intervalx
        np.testing.assert_allclose(
            [begin, end], [transfer["begin_s"], transfer["end_s"]], atol=1e-6
        )
    check_picture(figure)


def test_the_figure_says_what_the_agents_are_to_do(flight_field, followed, monkeypatch):
    monkeypatch.setattr(plotting, "plot_field", lambda *_: [])
    good, first = np.array([True, True, False]), slice(0, 3)
    positions, errors = followed.positions[:, first], followed.errors[:, first]
    for is_open, title in (
        (np.zeros(3, bool), "2 of 3 starts complete a lap"),
        (np.ones(3, bool), "2 of 3 starts come to rest at the end"),
        (
            np.array([True, False, False]),
            "2 of 3 starts complete a lap or come to rest at the end",
        ),
    ):
        done = {"lapped": good & ~is_open, "ended": good & is_open}
        metrics = replace(followed.metrics, open=is_open, **done)
        three = replace(followed, positions=positions, errors=errors, metrics=metrics)
        assert figures.follow_figure(flight_field, three).axes[0].get_title() == title


@pytest.mark.parametrize(
    ("dim", "names"), [(2, ["x", "y"]), (3, ["x", "y", "z"]), (4, ["x0", "x1", "x2", "x3"])]
)
def test_the_table_holds_every_trajectory(followed, dim, names):
    steps, agents, _ = followed.positions.shape
    positions = np.arange(steps * agents * dim, dtype=float).reshape(steps, agents, dim)
    table = figures.trajectory_table(replace(followed, positions=positions))
    assert list(table.columns) == ["agent", "time", *names, "cross_track_error"]
    assert len(table) == steps * agents
    one = table[table["agent"] == 5]
    np.testing.assert_array_equal(one["time"], followed.times)
    np.testing.assert_array_equal(one[names], positions[:, 5])
    np.testing.assert_array_equal(one["cross_track_error"], followed.errors[:, 5])
