"""Degrees to metres, against numerical derivatives, an arc by quadrature and known lengths."""

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from scipy.integrate import quad

from sgvf_drake.clouds.geodesy import earth_centred, east_north_up, middle, origin_text

PLACES = {
    "latitude": st.floats(-89.9, 89.9),
    "longitude": st.floats(-180, 180),
    "height": st.floats(-400, 9000),
}


@settings(max_examples=50, derandomize=True)
@given(**PLACES)
@example(latitude=0.0, longitude=180.0, height=0.0)
def test_the_axes_are_the_derivatives_of_the_place(latitude, longitude, height):
    place = np.array([latitude, longitude, height])
    steps = np.diag([1e-4, 1e-4, 10.0])
    differences = np.array(
        [earth_centred(*(place + step)) - earth_centred(*(place - step)) for step in steps]
    )
    lengths = np.linalg.norm(differences, axis=1)
    # North, east and up are where latitude, longitude and height grow.
    local = np.array(
        [
            east_north_up(*(place + step), tuple(place))
            - east_north_up(*(place - step), tuple(place))
            for step in steps
        ]
    )
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), lengths, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(
        local / lengths[:, None], [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6
    )


def test_the_ellipsoid_is_that_of_the_published_figures():
    a, b = 6_378_137.0, 6_356_752.314245
    np.testing.assert_allclose(
        earth_centred([0, 90], [0, 0], [0, 0]), [[a, 0, 0], [0, 0, b]], atol=1e-6
    )
    # One second of arc about a place: radii of curvature, by the arc of an ellipse.
    for latitude in (0.0, 12.5, 48.0, -77.0):

        def speed(u):
            return np.hypot(a * np.sin(u), b * np.cos(u))

        def reduced(degrees):
            return np.arctan(b / a * np.tan(np.radians(degrees)))

        half = 0.5 / 3600
        arc = quad(speed, reduced(latitude - half), reduced(latitude + half))[0]
        ends = east_north_up(
            np.array([latitude - half, latitude + half]),
            np.array([9.0, 9.0]),
            np.zeros(2),
            (latitude, 9.0, 0.0),
        )
        np.testing.assert_allclose(ends[1, 1] - ends[0, 1], arc, rtol=1e-8)
        # A parallel is a circle.
        radius = a * np.cos(reduced(latitude))
        turned = np.array([9.0 - half, 9.0 + half])
        ends = east_north_up(np.full(2, latitude), turned, np.zeros(2), (latitude, 9.0, 0.0))
        np.testing.assert_allclose(
            ends[1, 0] - ends[0, 0], radius * np.radians(2 * half), rtol=1e-8
        )


@settings(max_examples=50, derandomize=True)
@given(latitude=st.floats(-89, 89), longitude=st.floats(-180, 180), seed=st.integers(0, 99))
@example(latitude=0.0, longitude=179.9999, seed=0)
@example(latitude=89.9999, longitude=-40.0, seed=1)
def test_distances_stay_wherever_on_earth_the_origin_is(latitude, longitude, seed):
    rng = np.random.default_rng(seed)
    latitudes = np.clip(latitude + rng.uniform(-0.01, 0.01, 20), -90, 90)
    longitudes = (longitude + rng.uniform(-0.01, 0.01, 20) + 180) % 360 - 180
    heights = rng.uniform(0, 100, 20)
    origin = middle(latitudes, longitudes)
    local = east_north_up(latitudes, longitudes, heights, origin)
    whole = earth_centred(latitudes, longitudes, heights)
    np.testing.assert_allclose(
        np.linalg.norm(local - local[0], axis=1),
        np.linalg.norm(whole - whole[0], axis=1),
        atol=1e-7,
    )
    # The origin is amid the places, and told without rounding.
    assert np.abs(local[:, :2].mean(axis=0)).max() < 2
    assert origin == tuple(round(value, 5) for value in origin)


def test_an_origin_in_words():
    assert origin_text((12.5, -38.25, 0.0)) == "12.50000 N, 38.25000 W"
    assert origin_text((-0.00001, 179.99999, 7.0)) == "0.00001 S, 179.99999 E"
