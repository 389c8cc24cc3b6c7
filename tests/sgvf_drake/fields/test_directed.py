"""Directed fields against sums over components, finite differences, files, compiled code."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError, FieldFileError
from sgvf_drake.fields import (
    DirectedField,
    GaussianMixture,
    RobustComposition,
    StrandMixture,
    load_field,
    load_guiding_field,
)
from sgvf_drake.fields.strands import ONE_WAY_SHARPNESS, TWO_WAY_SHARPNESS
from sgvf_drake.learning.strands import find_strands
from sgvf_drake.paths.finding import find_paths
from tests.fields import DIRECTED_KINDS as KINDS
from tests.fields import random_directed_field as field_of
from tests.fields import random_strands as strands_of
from tests.networks import SHAPES

Array = NDArray[np.float64]


def samples(dim: int, count: int = 12, scale: float = 1.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    g = rng.normal(size=(count, dim))
    return scale * rng.uniform(-1, 1, (count, dim)), g / np.linalg.norm(g, axis=1)[:, None]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["one-way", "two-way", "both"])
def test_the_mixture_is_the_sum_over_its_components(kind: str, dim: int) -> None:
    mixture = strands_of(kind, dim)
    assert isinstance(mixture, StrandMixture)
    for x, g in zip(*samples(dim), strict=True):
        total, score, pull = 0.0, np.zeros(dim), np.zeros(dim)
        for z, T, one_way in zip(
            mixture.points, mixture.directions, mixture.one_way, strict=True
        ):
            near = np.exp(-((x - z) ** 2).sum() / (2 * mixture.sigma**2))
            kappa = ONE_WAY_SHARPNESS if one_way else TWO_WAY_SHARPNESS
            # A two-way strand is two one-way strands of opposite directions.
            for sign, share in ((1, 1.0),) if one_way else ((1, 0.5), (-1, 0.5)):
                w = share * near * np.exp(kappa * sign * (T @ g))
                total += w
                score += w * (z - x) / mixture.sigma**2
                pull += w * sign * T
        S, N = mixture(x[None], g[None])
        np.testing.assert_allclose(S[0], score / total, rtol=1e-10)
        np.testing.assert_allclose(N[0], pull / total, rtol=1e-10, atol=1e-12)


def test_one_way_strands_without_a_direction_are_a_plain_mixture() -> None:
    mixture = strands_of("one-way", 2)
    assert isinstance(mixture, StrandMixture)
    x, _ = samples(2)
    plain = GaussianMixture(mixture.points, mixture.sigma)
    np.testing.assert_allclose(mixture(x, np.zeros_like(x))[0], plain.score(x), rtol=1e-12)


@pytest.mark.parametrize("kind", ["two-way", "learned two-way"])
def test_two_way_strands_are_even_in_the_score_and_odd_in_the_tangent(kind: str) -> None:
    x, g = samples(3)
    S, N = strands_of(kind, 3)(x, g)
    S_back, N_back = strands_of(kind, 3)(x, -g)
    np.testing.assert_allclose(S_back, S, rtol=1e-10)
    np.testing.assert_allclose(N_back, -N, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_central_differences(kind: str, dim: int, ends: bool) -> None:
    motion = field_of(kind, dim, ends).with_memory()
    y = np.concatenate(samples(dim, scale=3), axis=1)
    _, J = motion.value_and_jacobian(y)
    H = motion.hessian(y)
    for k, step in enumerate(1e-6 * np.eye(2 * dim)):
        slope = (motion(y + step) - motion(y - step)) / 2e-6
        np.testing.assert_allclose(J[:, :, k], slope, rtol=1e-6, atol=1e-6 * abs(J).max())
        ahead, behind = (motion.value_and_jacobian(y + s * step)[1] for s in (1, -1))
        np.testing.assert_allclose(
            H[..., k], (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-6 * abs(H).max()
        )


@pytest.mark.parametrize("dim", [2, 3])
def test_a_held_direction_makes_a_field_of_the_position(dim: int) -> None:
    field = field_of("both", dim)
    x, g = samples(dim)
    motion = field.with_memory()
    y = np.concatenate([x, g], axis=1)
    F, J = motion.value_and_jacobian(y)
    np.testing.assert_allclose(field(x, g), F[:, :dim], rtol=1e-12)
    np.testing.assert_allclose(field.heading(g)(x), F[:, :dim], rtol=1e-12)
    np.testing.assert_allclose(field.value_and_jacobian(x, g)[1], J[:, :dim, :dim], rtol=1e-9)
    by_g = field.jacobian_by_direction(x, g)
    np.testing.assert_allclose(by_g, J[:, :dim, dim:], rtol=1e-9)
    np.testing.assert_allclose(
        field.hessian(x, g), motion.hessian(y)[:, :dim, :dim, :dim], rtol=1e-9, atol=1e-9
    )
    turn = (field.tangent(x, g) - g) / field.memory_length
    np.testing.assert_allclose(F[:, dim:], turn, rtol=1e-12)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_the_compiled_motion_is_the_same(kind: str, dim: int, ends: bool) -> None:
    motion = field_of(kind, dim, ends).with_memory()
    compiled = motion.compiled()
    for y in np.concatenate(samples(dim, scale=3), axis=1):
        F, J = motion.value_and_jacobian(y)
        flat = compiled.evaluate(y)
        np.testing.assert_allclose(flat[: 2 * dim], F, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(
            flat[2 * dim :].reshape(J.shape), J, rtol=1e-8, atol=1e-9 * abs(J).max()
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_gives_the_same_field_back(kind: str, tmp_path: Path) -> None:
    field = field_of(kind, 2, ends=True)
    network = find_paths(PointCloud(SHAPES["T"].sample(200, 0.0, random=False, seed=0)))
    field = DirectedField(**{**vars(field), "path_network": network})
    file = tmp_path / "field.safetensors"
    field.save(file)
    again = load_field(file)
    assert isinstance(again, DirectedField)
    x, g = samples(2)
    np.testing.assert_allclose(again(x, g), field(x, g), rtol=1e-12)
    assert again.network.to_json() == network.to_json()
    with pytest.raises(ConfigurationError, match="is a directed field"):
        load_guiding_field(file)
    data = file.read_bytes()
    for word in (b"mixture", b"one-way", b"two-way"):
        data = data.replace(word, word[:-1] + b"x")
    file.write_bytes(data)
    with pytest.raises(FieldFileError, match="unknown strands"):
        load_field(file)


def test_a_network_wants_a_direction_and_a_course_does_not() -> None:
    for name, needs in (("T", True), ("eight", False)):
        cloud = PointCloud(SHAPES[name].sample(300, 0.0, random=False, seed=0))
        network = find_paths(cloud)
        mixture = find_strands(cloud, network).mixture
        field = DirectedField(
            cloud=cloud,
            sigma=mixture.sigma,
            composition=RobustComposition(2 * mixture.sigma, mixture.sigma),
            recipe="exact",
            seed=0,
            path_network=network,
            strands=mixture,
        )
        if needs:
            with pytest.raises(ConfigurationError, match=r"field\(x, g\)"):
                field(cloud.points)
        else:
            zero = np.zeros(2)
            np.testing.assert_array_equal(field(cloud.points), field(cloud.points, zero))
    with pytest.raises(ValueError, match="directions of shape"):
        field(cloud.points, np.zeros(3))
