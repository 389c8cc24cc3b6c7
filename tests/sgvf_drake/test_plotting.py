"""Every plot: what is drawn, in which colours, and with which labels."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import same_color
from matplotlib.lines import Line2D
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from sgvf_drake import plotting

TIMES = np.linspace(0.0, 10.0, 101)

# As users have it; see `plain_pictures`.
DENSITY = plotting.STREAM_DENSITY


class Rotation:
    """Counter-clockwise around the origin."""

    dim = 2

    def __call__(self, x):
        return np.stack([-x[:, 1], x[:, 0]], axis=-1)


@pytest.fixture
def axes():
    return plotting.new_figure(1, 1, 4, 3)[1][0]


def trajectories(agents):
    """Agents (T, n, 2) that move to the right, one above the other."""
    x = np.broadcast_to(TIMES[:, None], (len(TIMES), agents))
    y = np.broadcast_to(np.arange(agents, dtype=float), (len(TIMES), agents))
    return np.stack([x, y], axis=-1)


def lines_of(artists, color):
    return [
        artist
        for artist in artists
        if isinstance(artist, Line2D) and same_color(artist.get_color(), color)
    ]


def check_rendered(axes):
    """Something is drawn inside of the axes."""
    canvas = FigureCanvasAgg(axes.figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())
    box = axes.get_window_extent()
    height = pixels.shape[0]
    inside = pixels[
        height - int(box.y1) + 5 : height - int(box.y0) - 5, int(box.x0) + 5 : int(box.x1) - 5
    ]
    assert np.any(inside[..., :3] < 200, axis=2).mean() > 0.001


def test_figures_have_axes_row_by_row_and_stay_out_of_pyplot(axes):
    before = plt.get_fignums()
    figure, many = plotting.new_figure(2, 3, 9, 4)
    assert plt.get_fignums() == before
    assert figure.get_size_inches().tolist() == [9.0, 4.0]
    rows = [ax.get_subplotspec().rowspan.start for ax in many]
    assert rows == [0, 0, 0, 1, 1, 1]
    plotting.plane_axes(axes)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x", "y")
    plotting.plane_axes(axes, "m", "a title")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    assert (axes.get_title(), axes.get_aspect()) == ("a title", 1.0)


def test_field(axes, monkeypatch):
    monkeypatch.setattr(plotting, "STREAM_DENSITY", DENSITY)
    lower, upper = np.array([-2.0, -1.0]), np.array([2.0, 3.0])
    (lines,) = plotting.plot_field(axes, Rotation(), (lower, upper))
    assert len(lines.get_segments()) > 10
    for segment in lines.get_segments():
        # Streams of a rotation keep their distance from the origin.
        radius = np.linalg.norm(segment, axis=1)
        assert np.ptp(radius) < 0.05
    assert axes.get_xlim() == (-2.0, 2.0)
    assert axes.get_ylim() == (-1.0, 3.0)
    check_rendered(axes)


def test_waypoints(axes):
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    (line,) = plotting.plot_waypoints(axes, points)
    np.testing.assert_array_equal(line.get_xydata(), points[:, :2])
    assert line.get_linestyle() == "None"
    check_rendered(axes)


def rows_of(artists, color):
    """Which agents are drawn in a colour: the heights of their lines."""
    return {line.get_ydata()[0] for line in lines_of(artists, color)}


def test_failing_agents_have_another_colour_and_are_all_drawn(axes):
    artists = plotting.plot_trajectories(axes, trajectories(3))
    assert rows_of(artists, plotting.BLUE) == {0, 1, 2}
    assert rows_of(artists, plotting.RED) == set()
    check_rendered(axes)
    artists = plotting.plot_trajectories(axes, trajectories(4), [True, False, True, True])
    assert rows_of(artists, plotting.BLUE) == {0, 2, 3}
    assert rows_of(artists, plotting.RED) == {1}
    assert {"agent", "failed"} <= set(axes.get_legend_handles_labels()[1])
    # Of many agents a selection is drawn, but every failure.
    followed = np.arange(500) % 5 != 0
    artists = plotting.plot_trajectories(axes, trajectories(500), followed)
    good = rows_of(artists, plotting.BLUE)
    assert len(good) == plotting.MAX_TRAJECTORIES
    assert min(good) < 10 < 490 < max(good)
    assert rows_of(artists, plotting.RED) == set(range(0, 500, 5))


def test_cross_track_of_one_agent_and_of_many(axes):
    error = 0.1 * np.exp(-TIMES)
    artists = plotting.plot_cross_track(axes, TIMES, error[:, None], "m")
    assert any(np.allclose(line.get_ydata(), error, atol=2e-5) for line in artists)
    assert "[m]" in axes.get_ylabel()
    assert axes.get_xlabel() == "time [s]"
    check_rendered(axes)
    # A perfect run is drawn too.
    axes = plotting.new_figure(1, 1, 4, 3)[1][0]
    plotting.plot_cross_track(axes, TIMES, np.zeros((len(TIMES), 3)), "m")
    check_rendered(axes)
    axes = plotting.new_figure(1, 1, 4, 3)[1][0]
    errors = np.exp(-TIMES / 2)[:, None] * np.linspace(1.0, 2.0, 21)
    artists = plotting.plot_cross_track(axes, TIMES, errors, "mm", "s at unit speed")
    assert len(artists) == 3
    labels = axes.get_legend_handles_labels()[1]
    assert set(labels) == {"5 % to 95 % of agents", "median", "largest"}
    for color, size in ((plotting.BLUE, 1.5), (plotting.RED, 2.0)):
        (drawn,) = lines_of(artists, color)
        np.testing.assert_allclose(drawn.get_ydata(), size * np.exp(-TIMES / 2), rtol=1e-9)
    # Of 21 agents, all but one on either side are between 5 % and 95 %.
    border = artists[0].get_paths()[0].vertices[:, 1]
    assert border.max() == pytest.approx(1.95)
    assert border.min() == pytest.approx(1.05 * np.exp(-TIMES[-1] / 2))
    assert "[mm]" in axes.get_ylabel()
    assert "[s at unit speed]" in axes.get_xlabel()


def test_intervals_reach_from_their_low_to_their_high_end(axes):
    plotting.plot_intervals(axes, [1.0, 2.0], [(3.0, 2.5, 4.0), (5.0, np.nan, np.nan)])
    (bars,) = axes.collections
    expected = [[[1.0, 2.5], [1.0, 4.0]], [[2.0, 5.0], [2.0, 5.0]]]
    np.testing.assert_allclose(bars.get_segments(), expected)


def test_velocity_and_propeller_forces():
    log = pd.DataFrame({"time": TIMES, "vx": np.cos(TIMES), "vy": np.sin(TIMES)})
    for number in (1, 2, 3, 4):
        log[f"force_{number}"] = 1.0 + 0.1 * number
    one, other = plotting.new_figure(1, 2, 8, 3)[1]
    x, y, speed = plotting.plot_velocity(one, log)
    for line, expected in ((x, log["vx"]), (y, log["vy"]), (speed, np.ones(len(log)))):
        np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)
    *forces, limit = plotting.plot_propeller_forces(other, log, 4.6)
    assert [line.get_ydata()[0] for line in forces] == pytest.approx([1.1, 1.2, 1.3, 1.4])
    assert len({line.get_color() for line in forces}) == 4
    assert list(limit.get_ydata()) == [4.6, 4.6]
    assert other.get_ylim()[0] == 0.0
    assert other.get_ylim()[1] > 4.6
    units = [axes.get_ylabel() for axes in (one, other)]
    assert units == ["velocity [m/s]", "propeller force [N]"]
    for axes in (one, other):
        assert axes.get_xlabel() == "time [s]"
        check_rendered(axes)


def test_losses(axes):
    history = pd.DataFrame(
        {
            "stage": "tangent",
            "iteration": np.arange(100),
            "orthogonality": np.geomspace(1.0, 0.01, 100),
            "score": np.nan,
            "total": 1.0,
        }
    )
    (line,) = plotting.plot_losses(axes, history)
    # The term of the other stage is left out, and so is the sum.
    assert line.get_label() == "orthogonality"
    assert line.get_ydata()[0] == pytest.approx(1.0)
    assert axes.get_title() == "tangent"
    assert axes.get_yscale() == "log"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("iteration", "loss")
    check_rendered(axes)
