"""A network while it is made: routes are fitted, cut, joined and given a direction."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.assembly import Graph
from sgvf_drake.paths.building import number, piece_of_strands, reversed_route
from sgvf_drake.paths.gaps import keep_away, may_go_on
from sgvf_drake.paths.geometry import chains, fit_courses, place_nodes
from sgvf_drake.paths.loops import Holes
from sgvf_drake.paths.network import PathNetwork, Route
from sgvf_drake.paths.polyline import signed_area
from sgvf_drake.paths.recording import Recording
from sgvf_drake.paths.reference import Piece, ReferencePath
from sgvf_drake.paths.rows import lie_in_rows

Direction = Literal["ccw", "cw", "reverse"]
DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

NEAR_ROUTE = 3.0
"""Waypoints farther than this many sigma from every route are strays."""

SEVERAL_PASSES = 1.5
"""A recording that runs along a path more often than this passes it several times."""


class Draft:
    """The graph of a cloud, its routes, and what is to be said about them."""

    def __init__(
        self,
        cloud: PointCloud,
        points: FloatArray,
        weights: FloatArray,
        graph: Graph,
        sigma: float,
    ) -> None:
        self._cloud, self._points, self._weights = cloud, points, weights
        self._graph, self._sigma = graph, sigma
        self._messages: list[str] = []
        place_nodes(graph, sigma)
        self._fit()

    def _fit(self) -> None:
        self._routes = chains(self._graph)
        self._courses = fit_courses(
            self._graph, self._routes, self._points, self._weights, self._sigma
        )
        waypoints = self._cloud.normalize(self._cloud.points)
        foot = ReferencePath(tuple(course.line for course in self._courses)).project(waypoints)
        self._foot = foot
        route = np.where(foot.distance < NEAR_ROUTE * self._sigma, foot.piece, -1)
        lines = [course.line for course in self._courses]
        self._recording = Recording(
            waypoints,
            route,
            foot.arc,
            lengths=np.array([line.length for line in lines]),
            closed=np.array([line.closed for line in lines]),
        )

    def doubt(self, holes: Holes | None, reach: float) -> str | None:
        """What the waypoints say against these paths, if anything.

        Args:
            holes: The holes between them; None where they tell nothing.
            reach: The widest gap that was bridged, had there been one.
        """
        found = self._graph, self._routes, self._courses
        lines = [course.line for course in self._courses]
        near = NEAR_ROUTE * self._sigma
        if lie_in_rows(lines, self._recording.points, self._foot, near):
            return "waypoints on both sides of a line lie in rows along it"
        if keep_away(*found):
            return "strands meet where there are no waypoints"
        scatter = max(course.scatter for course in self._courses)
        if holes is not None and holes.has_between(scatter, self._sigma, reach):
            return "a loop is narrower than the scale that shows these paths"
        recorded = any(self._recording.direction(k) for k in range(len(self._routes)))
        if not recorded and may_go_on(*found, self._sigma):
            return "a path may go on from one end to another"
        return None

    def use_recording(self, closed: bool | None) -> None:
        """Joins what the recording joins, and cuts or closes paths as the user says."""
        links = self._recording.links(NEAR_ROUTE * self._sigma)
        nodes = [(self._node(*link.first), self._node(*link.second)) for link in links]
        joined = sum(
            self._join(a, b, link.points) for (a, b), link in zip(nodes, links, strict=True)
        )
        if joined:
            self._messages.append(
                f"{joined} gaps between ends are closed where the order of the points goes on"
            )
            self._fit()
        if closed is None:
            return
        for k in self._single_routes():
            if self._routes[k].closed != closed:
                self._close(k) if closed else self._cut(k)
        self._fit()

    def _node(self, route: int, side: int) -> int:
        """The node at the start (0) or the end (1) of a route."""
        arm = self._routes[route].arms[-side]
        return self._graph.node((arm[0], 1 - arm[1]) if side else arm)

    def _join(self, a: int, b: int, via: FloatArray | None = None) -> bool:
        """Joins two ends of paths, unless they are none any more."""
        arms = self._graph.all_arms()
        if a == b or any(len(arms.get(node, ())) != 1 for node in (a, b)):
            return False
        self._graph.join(a, b, via)
        return True

    def _single_routes(self) -> list[int]:
        """The routes that are a whole piece."""
        piece = piece_of_strands(self._graph, self._routes, self._courses)
        of_route = [piece[chain.arms[0][0]] for chain in self._routes]
        junctions = {
            piece[arms[0][0]]
            for arms in self._graph.all_arms().values()
            if len(arms) > 2 and arms[0] not in self._graph.through
        }
        return [
            k for k, p in enumerate(of_route) if of_route.count(p) == 1 and p not in junctions
        ]

    def _close(self, k: int) -> None:
        self._join(self._node(k, 0), self._node(k, 1))

    def _cut(self, k: int) -> None:
        """Cuts a closed path where its recording ends, or else in its widest gap."""
        course = self._courses[k]
        sense = self._recording.direction(k)
        if sense:
            after, before = self._recording.ends(k)[::sense]
            self._messages.append("a closed path is cut at the ends of its recording")
        else:
            arc = np.sort(course.arc)
            widest = int(np.argmax(np.diff(np.append(arc, arc[0] + course.line.length))))
            ends = arc[[widest, (widest + 1) % len(arc)]]
            before, after = course.line.at(ends)
            self._messages.append("a closed path is cut in the widest gap of its waypoints")
        at = ReferencePath((course.line,)).project(np.array([before])).arc[0]
        arm = self._routes[k].arms[
            int(np.searchsorted(course.at_nodes[1:-1], at, side="right"))
        ]
        places = (before, after) if arm[1] == 0 else (after, before)
        self._graph.cut(arm[0], *places)

    def give_directions(
        self,
        direction: Direction | Sequence[Direction | None] | None,
        start: FloatArray | None,
    ) -> None:
        """Turns every route the way that the user, the recording or the rule says.

        Raises:
            ConfigurationError: If a direction or the start does not fit the path.
        """
        piece = piece_of_strands(self._graph, self._routes, self._courses)
        choices = direction_choices(direction, 1 + max(piece.values()))
        single = set(self._single_routes())
        for k, (chain, course) in enumerate(zip(self._routes, self._courses, strict=True)):
            choice = choices[piece[chain.arms[0][0]]]
            if k not in single and choice is not None:
                raise ConfigurationError(
                    f"direction {choice!r} is for a piece that is one path; piece "
                    f"{piece[chain.arms[0][0]] + 1} is a network"
                )
            if self._is_against(k, course.line, choice, start):
                self._routes[k], self._courses[k] = reversed_route(chain, course)
        given = direction is not None or start is not None
        if not given and self._cloud.velocities is not None:
            self._messages.append("the velocities give the direction of travel")
        elif not given and any(self._recording.direction(k) for k in single):
            self._messages.append("the order of the points gives the direction of travel")

    def _is_against(
        self, k: int, line: Piece, choice: Direction | None, start: FloatArray | None
    ) -> bool:
        """Whether a route is to be turned."""
        area = signed_area(line.vertices)
        if choice in ("ccw", "cw"):
            if line.vertices.shape[1] != 2 or not line.closed:
                raise ConfigurationError(
                    f"direction {choice!r} is for closed paths in the plane; an open one takes "
                    "a start, or 'reverse'"
                )
            return (area > 0) != (choice == "ccw")
        ends = line.vertices[[0, -1]]
        against = area < 0 if line.closed else bool(tuple(ends[1]) < tuple(ends[0]))
        if self._recording.direction(k):
            against = self._recording.direction(k) < 0
        if self._cloud.velocities is not None:
            against = self._against_velocities(k)
        if start is not None and not line.closed:
            far = np.linalg.norm(ends - self._cloud.normalize(start), axis=1)
            against = bool(far[1] < far[0])
        return against != (choice == "reverse")

    def _against_velocities(self, k: int) -> bool:
        """Whether the robot that recorded the waypoints drove against a route."""
        assert self._cloud.velocities is not None
        own = self._recording.route == k
        line, arc = self._courses[k].line, self._recording.arc[own]
        step = 1e-3 * line.length
        ends = [np.clip(arc + s, 0, line.length) for s in (-step, step)]
        along = line.at(ends[1]) - line.at(ends[0])
        return float((along * self._cloud.velocities[own]).sum()) < 0

    def network(self, unsure: str | None) -> PathNetwork:
        """Returns the network, in the unit of the waypoints."""
        if len(self._routes) == 1 and self._single_routes():
            passes = self._recording.passes(0) if self._recording.direction(0) else 1.0
            if passes > SEVERAL_PASSES:
                self._messages.append(
                    f"the points are {passes:.1f} passes of it, in their order"
                )
                # What lies between the passes, and not between paths, left the scales unsure.
                unsure = None
        nodes, edges, routes = number(self._graph, self._routes, self._courses, self._weights)
        cloud, U = self._cloud, self._cloud.unit_length
        kept = np.array([self._weights[course.waypoints].sum() for course in self._courses])
        variances = np.array([course.scatter**2 for course in self._courses])
        length = sum(course.line.length for course in self._courses)
        edges = tuple(
            replace(edge, line=self._moved(edge.line), scatter=edge.scatter * U)
            for edge in edges
        )
        network = PathNetwork(
            nodes=tuple(replace(node, place=cloud.denormalize(node.place)) for node in nodes),
            edges=edges,
            routes=tuple(Route.along(route.edges, edges, route.closed) for route in routes),
            unit_length=U,
            sigma=self._sigma * U,
            scatter=float(np.sqrt((variances * kept).sum() / max(kept.sum(), 1))) * U,
            spacing=length / cloud.num_points * U,
            dropped=round(float(self._weights.sum() - kept.sum())),
            unsure=unsure,
        )
        return replace(network, messages=self._sentences(network))

    def _moved(self, line: Piece) -> Piece:
        return Piece(self._cloud.denormalize(line.vertices), line.closed)

    def _sentences(self, network: PathNetwork) -> tuple[str, ...]:
        found = [f"piece {k + 1}: {network.describe(k)}" for k in range(network.num_pieces)]
        if network.dropped:
            of = f"{network.dropped} of {self._cloud.num_points} waypoints"
            found.append(f"{of} are left out as strays")
        return (*found, *self._messages)


def direction_choices(
    direction: Direction | Sequence[Direction | None] | None, pieces: int
) -> Sequence[Direction | None]:
    """Returns the direction of each piece, where one may be given for all.

    Raises:
        ConfigurationError: If they are not as many as the pieces, or one is unknown.
    """
    choices = (
        [direction] * pieces if direction is None or isinstance(direction, str) else direction
    )
    if len(choices) != pieces:
        raise ConfigurationError(
            f"direction has {len(choices)} entries, but the path has {pieces} pieces"
        )
    for choice in choices:
        if choice is not None and choice not in DIRECTIONS:
            raise ConfigurationError(f"direction is one of {DIRECTIONS}, not {choice!r}")
    return choices
