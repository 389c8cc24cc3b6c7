"""What guiding fields of score and tangent share, and the one of the position alone."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields.analytic import AnalyticField, NormalisedByCloud, check_positive
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.composition import Composition, RobustComposition
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import Perceptron, ScoreNetwork
from sgvf_drake.fields.rest import Rest
from sgvf_drake.paths import PathNetwork, ReferencePath, shape_path


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ScoreInducedField(NormalisedByCloud):
    """A field m = s + v of a cloud of waypoints, composed of a score and a tangent.

    Calls take and return NumPy float64 in the unit of the waypoints, for one point (d,) or
    a batch (n, d).  |m| is about 1 on the path whatever the unit, so speed times m is a
    velocity.  Inside, everything is normalised to a half-extent of 4.

    Attributes:
        cloud: The waypoints it was made from; their extent is the normalisation.
        sigma: The noise level of the score, normalised units.
        composition: How the score S and the tangent N make m.
        recipe: `paper`, `robust` or `exact`; `imported` where it was trained elsewhere.
        seed: The seed of the training run.
        support: The points whose mixture the score is that of, (M, d) in the user's unit;
            None: the waypoints themselves.
        end_points: The terminal ends of open paths, (E, d) in the user's unit, at which
            robots come to rest; None: there are none.
        path_network: The paths that it was trained for, in the user's unit; None: they are
            found in the waypoints when they are asked for.
        provenance: The rest of what is known of its making, as plain JSON values.
    """

    cloud: PointCloud
    sigma: float
    composition: Composition
    recipe: str
    seed: int
    support: FloatArray | None = None
    end_points: FloatArray | None = None
    path_network: PathNetwork | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.recipe}, seed {self.seed}, {self.cloud!r})"

    @property
    def mixture(self) -> GaussianMixture:
        """The exact mixture whose score is learned, in the user's unit."""
        points = self.cloud.points if self.support is None else self.support
        return GaussianMixture(points, self.sigma * self.cloud.unit_length)

    @property
    def ends(self) -> FloatArray:
        """The terminal ends of open paths, (E, d) in the user's unit; E may be zero."""
        return np.empty((0, self.dim)) if self.end_points is None else self.end_points

    @cached_property
    def network(self) -> PathNetwork:
        """The paths that it is for, in the user's unit."""
        if self.path_network is not None:
            return self.path_network
        # Imported here: a field of a file has its network, and does without numba.
        from sgvf_drake.paths.finding import find_paths

        support = PointCloud(self.mixture.points)
        found = find_paths(support)
        # Of older files: a path that looks closed has an end where the field does.
        missing = len(self.ends) > found.count("end") // 2
        return find_paths(support, closed=False) if missing else found

    @cached_property
    def path(self) -> ReferencePath:
        """The path that it is measured against: of a named shape the true one, else its own."""
        shape = self.cloud.shape
        return self.network.path if shape is None else shape_path(shape)

    def rescaled(self, factor: float) -> Self:
        """Returns the same field in another unit: positions are multiplied by `factor`.

        Raises:
            ConfigurationError: The factor is not a positive number.
        """
        check_positive("the scale", factor)
        support, ends = (
            None if points is None else points * factor
            for points in (self.support, self.end_points)
        )
        return replace(
            self,
            cloud=PointCloud(self.cloud.points * factor),
            support=support,
            end_points=ends,
            path_network=self.path_network and self.path_network.rescaled(factor),
        )

    @property
    def approach_length(self) -> float:
        """The distance sigma^2 / k_s over which m turns from approaching to following.

        In the user's unit: at a small distance r from the path, the part of m that points
        to it is r / approach_length.
        """
        return self.sigma**2 / self.composition.gain * self.cloud.unit_length

    def with_approach_length(self, length: float) -> Self:
        """Returns the field that turns to the path over another distance.

        A vehicle at speed v sees the path as a rate v / approach_length, which has to stay
        below its own bandwidth.

        Raises:
            ConfigurationError: The length is not a positive number.
        """
        check_positive("the length", length)
        gain = self.sigma**2 * self.cloud.unit_length / length
        return replace(self, composition=replace(self.composition, gain=gain))

    def _composed(
        self, z: FloatArray, S: FloatArray, N: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns s and v at normalised points, (n, d) each."""
        s, v = self.composition.components(S, N)
        if self.rest is not None:
            w = self.rest.weight(z)[:, None]
            s_rest, v_rest = self.rest.composition.components(S, N)
            s, v = s + w * (s_rest - s), v + w * (v_rest - v)
        return s, v

    def _composed_and_jacobian(
        self, z: FloatArray, S: FloatArray, dS: FloatArray, N: FloatArray, dN: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns m (n, d) and its derivatives (n, d, k), from those of S and N (n, d, k).

        The first d of the k variables are the position.
        """
        m, by_score, by_tangent = self.composition.value_and_partials(S, N)
        J = by_score @ dS + by_tangent @ dN
        if self.rest is None:
            return m, J
        w, dw = self.rest.weight_and_gradient(z)
        rest, by_score, by_tangent = self.rest.composition.value_and_partials(S, N)
        change = rest - m
        J_rest = by_score @ dS + by_tangent @ dN
        J = J + w[:, None, None] * (J_rest - J)
        J[:, :, : z.shape[1]] += change[:, :, None] * dw[:, None, :]
        return m + w[:, None] * change, J

    @cached_property
    def rest(self) -> Rest | None:
        """How it comes to rest at its ends, normalised; None: it has none."""
        if len(self.ends) == 0 or not isinstance(self.composition, RobustComposition):
            return None
        return Rest.at(self.cloud.normalize(self.ends), self.composition)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ComposedField(ScoreInducedField, AnalyticField):
    """A guiding field m(x) of the position alone.

    Attributes:
        score_model: The raw score S, a network or the exact mixture.
        tangent_network: The network N of the tangent field, d inputs and d outputs.
    """

    score_model: ScoreNetwork | GaussianMixture
    tangent_network: Perceptron

    def score(self, x: FloatArray) -> FloatArray:
        """Returns the raw score S ~ grad log p at t = 1, per unit of length."""
        z, shape = self._normalized(x)
        return self.score_model.score(z).reshape(shape) / self.cloud.unit_length

    def tangent(self, x: FloatArray) -> FloatArray:
        """Returns the tangent field v, no unit."""
        z, shape = self._normalized(x)
        return self.composition.tangent(self.tangent_network(z)).reshape(shape)

    def components(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns s and v of m = s + v as they stand in m: the normalised score, the rest.

        Of shape (d,) or (n, d), as x.  In the robust composition both are weighted, and the
        part of the score along the tangent is taken out near the path.
        """
        z, shape = self._normalized(x)
        s, v = self._components(z)
        return s.reshape(shape), v.reshape(shape)

    def _value(self, z: FloatArray) -> FloatArray:
        s, v = self._components(z)
        return s + v

    def _components(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self._composed(z, self.score_model.score(z), self.tangent_network(z))

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self._composed_and_jacobian(
            z,
            *self.score_model.score_and_jacobian(z),
            *self.tangent_network.value_and_jacobian(z),
        )
