"""Networks: robots that hold one direction in each leg, and certificates that are refused."""

from dataclasses import replace
import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.certificate import NetworkCertificate, certify_network, check_network
from sgvf_drake.certificate.legs import Leg, are_chained, lies_in
from sgvf_drake.certificate.network import Place
from sgvf_drake.certificate.tube import TICK, Tube
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.paths.itinerary import Itinerary, successors
from sgvf_drake.paths.navigator import Navigator
from sgvf_drake.paths.planning import covering
from tests.conftest import directed_field
from tests.helpers import circle


@pytest.fixture(scope="module")
def tee(tee_field):
    return tee_field, certify_network(tee_field, covering(tee_field.network))


@pytest.fixture(scope="module")
def eight(eight_field):
    return eight_field, certify_network(eight_field, covering(eight_field.network))


@pytest.fixture(scope="module")
def spatial():
    field = directed_field("Y in space")
    return field, certify_network(field, covering(field.network))


def coordinates(section, z):
    """How far points (n, d) are along the normal of a section, and where in it, (n, d)."""
    rows = TICK * np.array(section, float)
    normal = np.linalg.svd(rows[1:])[2][-1]
    normal *= np.sign(np.linalg.det([normal, *rows[1:]]))
    return np.linalg.solve(np.column_stack([normal, *rows[1:]]), (z - rows[0]).T).T


def passed(field, leg, start):
    """Where a robot passes the last section of a leg, normalised, and after what time.

    On the way it is seen that it passes some of the other sections within their sides.
    """
    motion, g, time = field.with_memory().compiled(), np.array(leg.direction), 0.0

    def rate(_, z):
        return motion.evaluate(np.append(field.cloud.denormalize(z), g))[: len(g)]

    for section in [*leg.tube.sections[5:-3:8], leg.tube.sections[-1]]:

        def ahead(_, z, section=section):
            near = np.linalg.norm(z - TICK * np.array(section[0])) < 0.1
            return coordinates(section, z[None])[0, 0] if near else -1.0

        ahead.terminal, ahead.direction = True, 1.0
        tolerances = {"rtol": 1e-8, "atol": 1e-9, "max_step": 0.02}
        run = solve_ivp(rate, (0, 20.0), start, "DOP853", events=ahead, **tolerances)
        assert run.status == 1
        start, time = run.y[:, -1], time + run.t[-1]
        assert np.abs(coordinates(section, start[None])[0, 1:]).max() <= 1 + 1e-6
    return start, time


def corners(disk):
    """The middle of a disk and its corners, normalised."""
    rows = TICK * np.array(disk, float)
    signs = np.array(
        [(0,) * (len(rows) - 1), *itertools.product((-1, 1), repeat=len(rows) - 1)]
    )
    return rows[0] + signs @ rows[1:]


def assert_robots_are_within(field, found, stretches):
    """Robots from the first disk of the first stretch pass all of them, in the time."""
    unit = field.cloud.unit_length
    for z in corners(stretches[0].place.between(found.disks)[0]):
        for stretch in stretches:
            taken = 0.0
            for leg in stretch.legs:
                z, time = passed(field, leg, z)
                taken += unit * time
            assert stretch.time_low <= taken <= stretch.time_high


def test_everything_of_a_t_is_proved(tee):
    field, found = tee
    following = successors(field.network)
    assert found.certified
    assert len(found.sections) == 6
    assert {(own.place.before, own.place.after) for own in found.turns} == {
        (number, after) for number, numbers in following.items() for after in numbers
    }
    assert all(stretch.proved for stretch in found.stretches)
    assert len(found.ends) == 3


@pytest.mark.parametrize("turn", [0, 2, 4])
def test_robots_take_sections_and_turns_in_the_time_that_is_proved(tee, turn):
    field, found = tee
    place = found.turns[turn].place
    route = found.along([place.before, place.after], closed=False)
    assert_robots_are_within(field, found, route)


def test_a_lap_of_an_eight_takes_the_time_that_is_proved(eight):
    field, found = eight
    assert found.certified
    lap = found.along(found.route, closed=True)
    assert_robots_are_within(field, found, lap)
    assert found.route_time_low == pytest.approx(sum(own.time_low for own in lap))
    assert found.route_time_high < 1.02 * found.route_time_low


def test_robots_with_a_heading_take_about_the_time_that_is_proved(eight):
    """Their heading turns gradually: an idealisation less, which the proof does not cover."""
    field, found = eight
    route = Itinerary.along(found.route, field.network)
    step = 0.1 * field.memory_length
    navigator = Navigator(route, field.memory_length, step=step)
    motion, state = field.with_memory(), navigator.at(np.zeros(1))
    y = np.concatenate([route.line.at(np.zeros(1)), navigator.direction(state)], axis=1)
    laps, time = [], 0.0

    def rate(y, g):
        F = motion(y)
        F[:, 2:] = (g - y[:, 2:]) / motion.memory_length
        return F

    while len(laps) < 2:
        g = navigator.direction(state)
        middle = y + step / 2 * rate(y, g)
        y, time = y + step * rate(middle, g), time + step
        state = navigator.advance(state, y[:, :2])
        if state.arc[0] >= (1 + len(laps)) * route.length:
            laps.append(time)
    assert laps[1] - laps[0] == pytest.approx(found.route_time_high, rel=0.02)


def test_tubes_are_near_the_edges_that_they_follow(tee):
    field, found = tee
    path = field.network.path
    for stretch in found.sections:
        points = np.concatenate([corners(s) for s in stretch.legs[0].tube.sections])
        off = path.project(field.cloud.denormalize(points)).distance.max()
        assert off <= stretch.off < field.memory_length


def test_the_file_says_what_was_proved(tee, tmp_path):
    field, found = tee
    found.save(tmp_path / "network.json")
    loaded = NetworkCertificate.load(tmp_path / "network.json")
    assert loaded == found
    checked = check_network(loaded, field)
    assert checked.certified
    assert checked.is_as_strong_as(found)


@pytest.mark.parametrize("key", ["time_high", "boxes", "route"])
def test_a_file_that_was_changed_is_refused(tee, key):
    text = tee[1].to_json()
    at = text.index(f'"{key}"') + len(key) + 4
    digit = next(k for k in range(at, len(text)) if text[k].isdigit())
    changed = text[:digit] + str((int(text[digit]) + 1) % 10) + text[digit + 1 :]
    with pytest.raises(ConfigurationError, match="changed"):
        NetworkCertificate.from_json(changed)


def with_turn(found, change):
    """The certificate with another last leg of its first turn, and what it claims of that."""
    turn = found.turns[0]
    *legs, last = turn.legs
    other = replace(turn, legs=(*legs, replace(last, tube=change(last.tube))))
    stretches = tuple(other if own is turn else own for own in found.stretches)
    return replace(found, stretches=stretches), turn.place


def moved(tube):
    """A tube that is moved by a tenth of its width, which no other number tells."""
    step = np.array(tube.sections[0][1]) // 10
    ticks = np.array(tube.sections)
    ticks[:, 0] += step
    return Tube(tuple(tuple(map(tuple, rows)) for rows in ticks.tolist()), closed=False)


def cut(tube):
    return replace(tube, sections=tube.sections[:-1])


def begun_later(tube):
    return replace(tube, sections=tube.sections[1:])


@pytest.mark.parametrize("change", [moved, cut, begun_later])
def test_a_turn_that_is_not_chained_is_refused(tee, change):
    field, found = tee
    changed, place = with_turn(found, change)
    checked = check_network(changed, field)
    assert not checked.certified
    assert not next(own for own in checked.turns if own.place == place).proved


def test_a_bound_that_is_not_proved_is_refused(tee):
    field, found = tee
    first, *others = found.stretches
    short = replace(first, time_high=0.999 * first.time_high)
    assert not check_network(replace(found, stretches=(short, *others)), field).certified


def test_disks_of_another_network_are_refused(tee):
    field, found = tee
    with pytest.raises(ConfigurationError, match="the disks of this network"):
        check_network(replace(found, disks=found.disks[1:]), field)


def test_a_certificate_of_another_field_is_refused(tee, eight):
    with pytest.raises(ConfigurationError, match="another field"):
        check_network(tee[1], eight[0])


def test_a_route_that_the_network_does_not_have_is_refused(tee):
    field, found = tee
    with pytest.raises(ConfigurationError):
        check_network(replace(found, route=(1, 1), route_closed=False), field)


def test_a_turn_that_robots_do_not_make_is_not_proved(tee_field):
    """The stem begins so far below the bar that a robot stays on that."""
    strands, edges = tee_field.strands, tee_field.network.edges
    widths = [np.ptp(edge.line.vertices[:, 0]) for edge in edges]
    stem = -1 - int(np.argmin(widths))
    near = strands.points[:, 1] > strands.points[:, 1].max() - 0.6
    kept = ~near | (np.abs(strands.directions[:, 0]) > 0.5)
    arrays = {
        name: getattr(strands, name)[kept] for name in ("points", "directions", "one_way")
    }
    found = certify_network(replace(tee_field, strands=replace(strands, **arrays)))
    proved = {(own.place.before, own.place.after): own.proved for own in found.turns}
    lost = [own for own in found.turns if own.place.after == stem != -own.place.before]
    assert not found.certified
    assert len(lost) == 2
    top = tee_field.cloud.points[:, 1].max()
    for turn in lost:
        assert not turn.proved
        assert turn.where[1] > top - tee_field.memory_length
    assert all(proved[pair] for pair in proved if abs(stem) not in map(abs, pair))


def disk(*rows):
    return tuple(tuple(row) for row in rows)


@pytest.mark.parametrize(
    ("inner", "outer", "expected"),
    [
        (disk((0, 0), (3, 6)), disk((0, 0), (4, 8)), True),
        (disk((1, 2), (3, 6)), disk((0, 0), (4, 8)), True),
        (disk((2, 4), (3, 6)), disk((0, 0), (4, 8)), False),
        (disk((0, 0), (-4, -8)), disk((0, 0), (4, 8)), True),
        (disk((0, 0), (4, 7)), disk((0, 0), (4, 8)), False),
        (disk((0, 1), (2, 4)), disk((0, 0), (4, 8)), False),
        (disk((2**32, 1), (2**32, 0)), disk((2**32 - 1, 1), (2**32, 0)), False),
        (disk((0, 0, 5), (1, 1, 0), (1, -1, 0)), disk((0, 0, 5), (2, 0, 0), (0, 2, 0)), True),
        (disk((0, 0, 5), (1, 1, 0), (2, -1, 0)), disk((0, 0, 5), (2, 0, 0), (0, 2, 0)), False),
        (disk((0, 0, 5), (1, 1, 1), (1, -1, 0)), disk((0, 0, 5), (2, 0, 0), (0, 2, 0)), False),
        (disk((0, 0, 5), (0, 1, 0), (1, 0, 0)), disk((0, 0, 5), (2, 0, 0), (1, 0, 0)), False),
    ],
)
def test_disks_lie_in_others_to_the_last_bit(inner, outer, expected):
    assert lies_in(inner, outer) is expected


def test_an_open_leg_between_others_is_no_chain(tee):
    legs = tee[1].turns[0].legs
    start, end = legs[0].tube.sections[0], legs[-1].tube.sections[-1]
    assert are_chained(legs, start, end)
    assert not are_chained(legs[::-1], start, end)
    assert not are_chained(legs, start, None)


@pytest.mark.parametrize("direction", [(1.0,), (1.0, 1.0), (np.nan, 0.0)])
def test_a_leg_has_a_direction(tee, direction):
    with pytest.raises(ValueError, match="direction"):
        Leg(direction, tee[1].turns[0].legs[0].tube)


def test_places_say_where_they_are():
    assert str(Place(-3, -3, 0)) == "section 1 of edge -3"
    assert str(Place(-3, 2)) == "turn from edge -3 into 2"
    assert str(Place(2, None)) == "rest at the end of edge 2"


@pytest.mark.full
def test_robots_in_space_take_turns_in_the_time_that_is_proved(spatial):
    field, found = spatial
    assert found.certified
    for turn in found.turns:
        assert_robots_are_within(field, found, [turn])


@pytest.mark.full
def test_a_loop_without_a_node_returns_into_itself():
    """A circle of radius 2 beside a cross: its lap is 4 pi."""
    line = np.linspace(-2, 2, 100)
    cross = np.concatenate([np.column_stack([line, sign * line]) for sign in (1, -1)])
    points = np.concatenate([circle(2.0, 150) - [7.0, 0.0], cross])
    field = train(PointCloud(points), TrainingConfig(recipe="exact", max_restarts=0)).field
    number = 1 + next(k for k, e in enumerate(field.network.edges) if e.nodes is None)
    found = certify_network(field, Itinerary.along([number], field.network))
    assert found.certified
    assert found.route_closed
    assert found.route_time_low < 4 * np.pi < found.route_time_high
    assert_robots_are_within(field, found, found.along(found.route, closed=True))


@pytest.mark.full
def test_an_open_path_that_crosses_itself_leads_to_rest():
    u = np.linspace(-1.25, 1.25, 300)
    points = np.column_stack([3 * u**2 - 3, 4.8 * (u**3 - u)])
    field = train(PointCloud(points), TrainingConfig(recipe="exact", max_restarts=0)).field
    found = certify_network(field, covering(field.network))
    (end,) = found.ends
    assert found.certified
    assert not found.route_closed
    assert end.proved
    assert end.place.before == found.route[-1]
    assert check_network(found, field).certified
