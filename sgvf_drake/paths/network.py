"""A network of paths: nodes, the edges between them, and the routes that run through crossings.

A path without crossings is a network too: one edge, with two ends or closed in itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import json
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.reference import Piece, ReferencePath

FORMAT, VERSION = "sgvf-path-network", 1

NodeKind = Literal["end", "junction", "crossing"]
"""An end has one arm; a junction leaves a choice; a crossing is driven straight over."""


@dataclass(frozen=True, eq=False)
class Node:
    """A place where edges end or meet.

    Attributes:
        place: (d,) in the unit of the waypoints.
        kind: What it is.
        degree: The number of its arms.
        piece: The number of the piece that it belongs to.
    """

    place: FloatArray
    kind: NodeKind
    degree: int
    piece: int


@dataclass(frozen=True, eq=False)
class Edge:
    """A part of a path between two nodes, or a closed path without nodes.

    Attributes:
        line: The polyline from its start to its end.
        nodes: The nodes at its start and its end; None for a closed path without nodes.
        piece: The number of the piece that it belongs to.
        scatter: Standard deviation of its waypoints across it, in each direction.
        weight: The share of the waypoints that lie on it.
    """

    line: Piece
    nodes: tuple[int, int] | None
    piece: int
    scatter: float
    weight: float

    @property
    def length(self) -> float:
        """Its length."""
        return self.line.length


@dataclass(frozen=True, eq=False)
class Route:
    """Edges that follow each other straight through crossings.

    Attributes:
        edges: The number of each edge, which is travelled from its start to its end.
        closed: Whether it returns to where it starts.
        line: Its polyline.
        piece: The number of the piece that it belongs to.
    """

    edges: tuple[int, ...]
    closed: bool
    line: Piece
    piece: int

    @classmethod
    def along(cls, numbers: Sequence[int], edges: Sequence[Edge], closed: bool) -> "Route":
        """Returns the route that runs along edges of these numbers, which follow each other."""
        own = [edges[number] for number in numbers]
        line = own[0].line
        if own[0].nodes is not None:
            parts = [edge.line.vertices[:-1] for edge in own]
            parts += [] if closed else [own[-1].line.vertices[-1:]]
            line = Piece(np.concatenate(parts), closed)
        return cls(tuple(numbers), closed, line, own[0].piece)


@dataclass(frozen=True, eq=False)
class PathNetwork:
    """What was found in a cloud, in the unit of its waypoints; the longest piece comes first.

    Attributes:
        nodes: Ends, junctions and crossings.
        edges: What joins them.
        routes: Every edge is part of one route.
        unit_length: U, an eighth of the extent of the cloud.
        sigma: The scale of the ridge on which the topology was read.
        scatter: Standard deviation of the waypoints across the paths, in each direction.
        spacing: Mean distance of neighbouring waypoints along the paths.
        dropped: The number of waypoints left out as strays.
        unsure: Why the points do not decide, and the option that does; None if they do.
        messages: What was found, left out and assumed, a sentence each.
    """

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    routes: tuple[Route, ...]
    unit_length: float
    sigma: float
    scatter: float
    spacing: float
    dropped: int
    unsure: str | None = None
    messages: tuple[str, ...] = ()

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return int(self.edges[0].line.vertices.shape[1])

    @cached_property
    def path(self) -> ReferencePath:
        """Its routes as the pieces of a path, those of the longest piece first."""
        return ReferencePath(tuple(route.line for route in self.routes))

    @cached_property
    def num_pieces(self) -> int:
        """The number of connected pieces."""
        return 1 + max(edge.piece for edge in self.edges)

    @property
    def length(self) -> float:
        """The length of all edges."""
        return sum(edge.length for edge in self.edges)

    @property
    def cycles(self) -> int:
        """The number of independent loops: edges - nodes + pieces, 1 for a plain loop."""
        plain = sum(edge.nodes is None for edge in self.edges)
        return len(self.edges) - len(self.nodes) + self.num_pieces - plain

    def count(self, kind: NodeKind) -> int:
        """The number of nodes of a kind."""
        return sum(node.kind == kind for node in self.nodes)

    def is_one_way(self, piece: int) -> bool:
        """Whether one route runs along a whole piece: a strand, a loop, or one with crossings.

        All other pieces are networks, whose edges can be travelled either way.
        """
        return sum(route.piece == piece for route in self.routes) == 1 and not any(
            n.kind == "junction" and n.piece == piece for n in self.nodes
        )

    def is_simple(self, piece: int) -> bool:
        """Whether a piece neither branches nor crosses itself.

        Only then has each of its places one direction of travel, as in a vector field.
        """
        return not any(node.piece == piece and node.kind != "end" for node in self.nodes)

    def kind(self, piece: int) -> str:
        """What a piece is: "closed path", "open path" or "network"."""
        if not self.is_one_way(piece):
            return "network"
        route = next(route for route in self.routes if route.piece == piece)
        return "closed path" if route.closed else "open path"

    def describe(self, piece: int) -> str:
        """Says what a piece is, in a few words."""
        kind = self.kind(piece)
        named: tuple[NodeKind, ...] = ("junction", "crossing", "end")
        if kind != "network":
            # Its ends are those of an open path.
            named = ("crossing",)
        nodes = [node.kind for node in self.nodes if node.piece == piece]
        counts = [
            f"{number} {name}" + "s" * (number > 1)
            for name in named
            if (number := nodes.count(name))
        ]
        length = sum(edge.length for edge in self.edges if edge.piece == piece)
        return f"{kind}, length {length:.4g}" + (
            f", with {', '.join(counts)}" if counts else ""
        )

    def rescaled(self, factor: float) -> "PathNetwork":
        """Returns the network in another unit of length: positions times `factor`."""
        edges = tuple(
            replace(edge, line=edge.line.rescaled(factor), scatter=edge.scatter * factor)
            for edge in self.edges
        )
        return replace(
            self,
            nodes=tuple(replace(node, place=node.place * factor) for node in self.nodes),
            edges=edges,
            routes=tuple(Route.along(r.edges, edges, r.closed) for r in self.routes),
            unit_length=self.unit_length * factor,
            sigma=self.sigma * factor,
            scatter=self.scatter * factor,
            spacing=self.spacing * factor,
        )

    def to_json(self) -> dict[str, Any]:
        """Returns plain data; `from_json` reads it back."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "unit_length": self.unit_length,
            "sigma": self.sigma,
            "scatter": self.scatter,
            "spacing": self.spacing,
            "dropped": self.dropped,
            "unsure": self.unsure,
            "messages": list(self.messages),
            "nodes": [
                {
                    "place": node.place.tolist(),
                    "kind": node.kind,
                    "degree": node.degree,
                    "piece": node.piece,
                }
                for node in self.nodes
            ],
            "edges": [
                {
                    "nodes": None if edge.nodes is None else list(edge.nodes),
                    "piece": edge.piece,
                    "length": edge.length,
                    "scatter": edge.scatter,
                    "weight": edge.weight,
                    "points": edge.line.vertices.tolist(),
                }
                for edge in self.edges
            ],
            "routes": [
                {"edges": list(route.edges), "closed": route.closed} for route in self.routes
            ],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "PathNetwork":
        """Makes a network of what `to_json` returned.

        Raises:
            PointCloudError: If the data are not those of a network of this version.
        """
        if data.get("format") != FORMAT or data.get("version") != VERSION:
            raise PointCloudError(f"this is no {FORMAT} of version {VERSION}")
        try:
            edges = tuple(
                Edge(
                    Piece(np.array(e["points"], float), closed=e["nodes"] is None),
                    None if e["nodes"] is None else (e["nodes"][0], e["nodes"][1]),
                    e["piece"],
                    e["scatter"],
                    e["weight"],
                )
                for e in data["edges"]
            )
            lengths = ("unit_length", "sigma", "scatter", "spacing")
            return cls(
                nodes=tuple(
                    Node(np.array(n["place"], float), n["kind"], n["degree"], n["piece"])
                    for n in data["nodes"]
                ),
                edges=edges,
                routes=tuple(
                    Route.along(r["edges"], edges, r["closed"]) for r in data["routes"]
                ),
                **{name: data[name] for name in (*lengths, "dropped", "unsure")},
                messages=tuple(data["messages"]),
            )
        except (KeyError, TypeError, IndexError, ValueError) as error:
            raise PointCloudError(f"the network is damaged: {error}") from error

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the network as a JSON file."""
        Path(path).write_text(json.dumps(self.to_json()), encoding="utf-8")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "PathNetwork":
        """Reads a network from a JSON file.

        Raises:
            PointCloudError: If the file is no network.
        """
        if not Path(path).is_file():
            raise PointCloudError(f"{path}: no such file")
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise PointCloudError(f"{path} is no network: {error}") from error
        if not isinstance(data, dict):
            raise PointCloudError(f"{path} is no network")
        try:
            return cls.from_json(data)
        except PointCloudError as error:
            raise PointCloudError(f"{path}: {error}") from error
