"""From a graph and its fitted routes to the network that users see: numbered and directed."""

from collections.abc import Sequence
from dataclasses import replace

import networkx as nx
import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.assembly import Arm, Graph
from sgvf_drake.paths.geometry import Chain, Course
from sgvf_drake.paths.network import Edge, Node, Route
from sgvf_drake.paths.reference import Piece


def reversed_route(chain: Chain, course: Course) -> tuple[Chain, Course]:
    """Returns a route travelled the other way."""
    arms = tuple((strand, 1 - side) for strand, side in reversed(chain.arms))
    vertices = course.line.vertices[::-1]
    if chain.closed:
        # It still starts where it did.
        vertices = np.roll(vertices, 1, axis=0)
    length = course.line.length
    return Chain(arms, chain.closed), replace(
        course,
        line=Piece(vertices, chain.closed),
        at_nodes=(length - course.at_nodes)[::-1],
        arc=length - course.arc,
    )


def number(
    graph: Graph, routes: Sequence[Chain], courses: Sequence[Course], weights: FloatArray
) -> tuple[tuple[Node, ...], tuple[Edge, ...], tuple[Route, ...]]:
    """Numbers pieces, the longest first, and their nodes, edges and routes by their places.

    Args:
        graph: The graph, in whatever unit.
        routes: Its routes.
        courses: Where they run.
        weights: How many waypoints each point of the courses counts for.
    """
    piece_of = piece_of_strands(graph, routes, courses)
    places = _places(graph, routes, courses)
    degrees = {node: len(arms) for node, arms in graph.all_arms().items()}
    crossings = {graph.node(arm) for arm in graph.through}
    piece_of_node = {
        node: piece_of[k] for k, strand in graph.strands.items() for node in strand.ends or ()
    }
    order = sorted(places, key=lambda node: (piece_of_node[node], *places[node]))
    index = {node: number for number, node in enumerate(order)}
    nodes = tuple(
        Node(
            places[node],
            "end" if degrees[node] == 1 else "crossing" if node in crossings else "junction",
            degrees[node],
            piece_of_node[node],
        )
        for node in order
    )
    edges = {
        arm[0]: _edge(graph, arm, course, k, index, places, piece_of[arm[0]], weights)
        for chain, course in zip(routes, courses, strict=True)
        for k, arm in enumerate(chain.arms)
    }
    numbered = sorted(
        edges,
        key=lambda k: (edges[k].piece, sorted(edges[k].nodes or ()), edges[k].length),
    )
    edge_index = {k: number for number, k in enumerate(numbered)}
    listed = tuple(edges[k] for k in numbered)
    found = [
        Route.along([edge_index[strand] for strand, _ in chain.arms], listed, chain.closed)
        for chain in routes
    ]
    found.sort(key=lambda route: (route.piece, min(route.edges)))
    return nodes, listed, tuple(found)


def piece_of_strands(
    graph: Graph, routes: Sequence[Chain], courses: Sequence[Course]
) -> dict[int, int]:
    """The number of the piece of each strand."""
    joined = nx.Graph()
    for chain in routes:
        nx.add_path(joined, [("strand", strand) for strand, _ in chain.arms])
        joined.add_node(("strand", chain.arms[0][0]))
    for k, strand in graph.strands.items():
        joined.add_edges_from((("strand", k), ("node", node)) for node in strand.ends or ())
    length = {
        chain.arms[0][0]: course.line.length
        for chain, course in zip(routes, courses, strict=True)
    }
    first = {
        chain.arms[0][0]: tuple(course.line.vertices.min(axis=0))
        for chain, course in zip(routes, courses, strict=True)
    }
    groups = [
        [k for kind, k in group if kind == "strand"]
        for group in nx.connected_components(joined)
    ]
    groups.sort(
        key=lambda group: (
            -round(sum(length.get(k, 0.0) for k in group), 9),
            min(first[k] for k in group if k in first),
        )
    )
    return {k: number for number, group in enumerate(groups) for k in group}


def _places(
    graph: Graph, routes: Sequence[Chain], courses: Sequence[Course]
) -> dict[int, FloatArray]:
    """Where each node lies: in the middle of the routes that run through it."""
    at: dict[int, list[FloatArray]] = {node: [] for node in graph.places}
    for chain, course in zip(routes, courses, strict=True):
        places = course.line.at(course.at_nodes)
        for k, arm in enumerate(chain.arms):
            if graph.strands[arm[0]].ends is not None:
                at[graph.node(arm)].append(places[k])
                at[graph.node((arm[0], 1 - arm[1]))].append(places[k + 1])
    return {node: np.mean(found, axis=0) for node, found in at.items()}


def _edge(
    graph: Graph,
    arm: Arm,
    course: Course,
    k: int,
    index: dict[int, int],
    places: dict[int, FloatArray],
    piece: int,
    weights: FloatArray,
) -> Edge:
    """Cuts the `k`-th edge out of a route."""
    begin, end = course.at_nodes[k], course.at_nodes[k + 1]
    on_edge = (course.arc >= begin) & (course.arc <= end)
    weight = float(weights[course.waypoints[on_edge]].sum() / weights.sum())
    if graph.strands[arm[0]].ends is None:
        return Edge(course.line, None, piece, course.scatter, weight)
    nodes = (graph.node(arm), graph.node((arm[0], 1 - arm[1])))
    inner = course.line.vertices[(course.line.arc > begin) & (course.line.arc < end)]
    vertices = np.concatenate([[places[nodes[0]]], inner, [places[nodes[1]]]])
    line = Piece(vertices, closed=False)
    return Edge(line, (index[nodes[0]], index[nodes[1]]), piece, course.scatter, weight)
