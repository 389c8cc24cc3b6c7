"""The figures of the commands, and the table of trajectories."""

from matplotlib.image import imread
import numpy as np
import pytest

from sgvf_drake.experiments import FollowResult, figures, fly_tour


def check_picture(path):
    """A file with a picture, of which something but not everything is drawn."""
    pixels = imread(path)[..., :3]
    drawn = np.any(pixels < 0.9, axis=2)
    assert min(drawn.shape) > 300
    assert 0.005 < drawn.mean() < 0.9
    # Every quarter of it holds something: no panel stayed empty.
    rows, columns = drawn.shape[0] // 2, drawn.shape[1] // 2
    for quarter in (
        *(drawn[:rows, :columns], drawn[:rows, columns:]),
        *(drawn[rows:, :columns], drawn[rows:, columns:]),
    ):
        assert quarter.mean() > 0.002


def test_training_figure(tmp_path, flight_result):
    figure = figures.training_figure(flight_result.field, flight_result.history)
    figure.savefig(tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def test_follow_figure(tmp_path, flight_field, followed):
    figures.follow_figure(flight_field, followed).savefig(tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def test_flight_figure(tmp_path, flight_field, flown):
    flight = flown.fast.flights[0]
    figure = figures.flight_figure(flight_field, flight_field.cloud, flight, flown.fast)
    figure.savefig(tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def test_tour_figure(tmp_path, flight_field, rings):
    tour = fly_tour(flight_field, rings, (0, 1), speed=2.0)
    figure = figures.tour_figure(flight_field, flight_field.cloud, tour)
    plane, error, velocity, forces = figure.axes
    assert "pieces 1, 2" in plane.get_title()
    (transfer,) = tour.transfers
    # The transfer is drawn, and shaded over time.
    away = plane.get_lines()[-2].get_ydata()
    assert 0 < np.isfinite(away).sum() < len(tour.log)
    for timeline in (error, velocity, forces):
        (shade,) = timeline.collections
        begin, end = shade.get_datalim(timeline.transData).intervalx
        np.testing.assert_allclose(
            [begin, end], [transfer["begin_s"], transfer["end_s"]], atol=1e-6
        )
    figure.savefig(tmp_path / "a.png")
    check_picture(tmp_path / "a.png")


def test_the_table_holds_every_trajectory(followed):
    table = figures.trajectory_table(followed)
    assert list(table.columns) == ["agent", "time", "x", "y", "cross_track_error"]
    steps, agents, _ = followed.positions.shape
    assert len(table) == steps * agents
    one = table[table["agent"] == 5]
    np.testing.assert_array_equal(one["time"], followed.times)
    np.testing.assert_array_equal(one[["x", "y"]], followed.positions[:, 5])
    np.testing.assert_array_equal(one["cross_track_error"], followed.errors[:, 5])


@pytest.mark.parametrize(
    ("dim", "names"), [(3, ["x", "y", "z"]), (4, ["x0", "x1", "x2", "x3"])]
)
def test_the_table_names_the_coordinates(rings, followed, dim, names):
    steps, agents, _ = followed.positions.shape
    positions = np.arange(steps * agents * dim, dtype=float).reshape(steps, agents, dim)
    result = FollowResult(
        followed.times,
        positions,
        followed.errors,
        followed.metrics,
        followed.speed_on_path,
        1.0,
    )
    table = figures.trajectory_table(result)
    assert list(table.columns[2:-1]) == names
    assert table[names].iloc[1].tolist() == positions[0, 1].tolist()
