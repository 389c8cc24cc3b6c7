"""The pieces of a point cloud and their order, from its Euclidean minimum spanning tree.

Waypoints come without an order.  Their minimum spanning tree gives one back: edges that
are long for the cloud separate its pieces, and along each piece the longest path of the
tree runs from one end to the other, so the geodesic distance from its start is an arc
length.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import PointCloudError

GAP_PERCENTILE = 90.0
"""The percentile of the tree's edges that stands for the spacing of a cloud."""

SMALLEST_GAP_FACTOR = 4.0
"""A gap is at least this many spacings: even sampling has none but true gaps that long."""

CUT_CHANCE = 0.01
"""Chance that a path sampled at random is torn by one of its own gaps."""

CLOSING_CHANCE = 0.001
"""Chance that a loop sampled at random is taken for an open path.

Smaller than `CUT_CHANCE`: the tree of a loop leaves out the longest of all gaps.
"""

BRIDGE_FACTOR = 1.3
"""A bridge between two loops is longer than this many spacings.

Much less than a gap: what tells a bridge is that the tree falls into loops without it.
"""

BRANCH_FACTOR = 1.0
"""A piece with a side branch of more than this many spacings may be several loops."""

MOST_BRIDGES = 8
"""Edges, the longest first, that are tried as bridges."""

LOOP_WAYPOINTS = 8
"""A loop beyond a bridge has at least this many waypoints; fewer are a knot of noise."""

END_SECTION = 0.1
"""Part of a path, at either end, that is searched for the closing edge of a loop.

The tree of a noisy loop does not break where its longest path ends but beside it, so the
two ends alone may lie farther apart than the sides of the break.
"""

CLOSING_RATIO = 2.5
"""A loop is at least this many times longer than the distance between its ends.

The four corners of a square (3) are a loop; points on a line (1) and on a semicircle
(1.57) are not, however few they are.
"""

NEIGHBORS = 12
"""Neighbours of each waypoint in the graph from which the tree is taken."""

COINCIDENT_DECIMALS = 12
"""Waypoints that agree to this many decimals of the half-extent are one waypoint."""


@dataclass(frozen=True, eq=False)
class TracedPiece:
    """One connected piece of a cloud, with the arc length of each of its waypoints.

    The direction of travel: a closed piece in the plane runs counter-clockwise.  A closed
    piece in more dimensions runs so that the largest component (in magnitude, among the
    pairs of axes i < j) of its area bivector, sum of x_i ^ x_{i+1} about the centroid, is
    positive.  An open piece starts at the end with the smaller x (then y, then z).

    Attributes:
        indices: (M,) the waypoints of this piece, ascending.
        arc: (M,) distance along the tree of each of `indices` from the start of the
            longest path, in [0, length]; waypoints on side branches included.
        order: (K,) waypoints on the longest path of the tree, from its start to its end.
            Of waypoints that coincide only the first is in it.
        edges: (M - 1, 2) the tree's edges; coincident waypoints hang on the first of them.
        closed: Whether the two ends of the longest path are neighbours; see `trace_pieces`.
        length: Length of the longest path, plus the closing edge when closed.
    """

    indices: IntArray
    arc: FloatArray
    order: IntArray
    edges: IntArray
    closed: bool
    length: float


@dataclass(frozen=True)
class _Gaps:
    """Lengths in the unit box: the spacing, the longest edge kept, the longest closing gap."""

    spacing: float
    cut: float
    closing: float


def trace_pieces(points: FloatArray) -> tuple[TracedPiece, ...]:
    """Splits a cloud into connected pieces and orders each of them.

    The minimum spanning tree is taken from the graph of `NEIGHBORS` nearest neighbours.
    Edges longer than `gap_length` at `CUT_CHANCE` are cut, and pieces that lie closer than
    that to each other are joined.  Loops that lie closer to each other than that, as in a
    sparse or noisy cloud, are told by their shape: where a piece has long side branches and
    falls into nothing but loops without a few of its longest edges, those are cut too.

    A piece is closed when waypoints of the first and of the last `END_SECTION` of its
    longest path lie within `gap_length` at `CLOSING_CHANCE` of each other, and the path is
    at least `CLOSING_RATIO` times as long as their distance.  The result does not depend
    on the order of the waypoints.

    Args:
        points: (N, d) waypoints, N >= 1, finite; any unit of length.

    Returns:
        The pieces, longest first; isolated waypoints are pieces of length 0.

    Raises:
        PointCloudError: if `points` is not a non-empty, finite array of two axes.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.size == 0 or not np.isfinite(points).all():
        raise PointCloudError(f"need finite waypoints (N, d), got an array {points.shape}")
    unit_points, scale = _to_unit_box(points)
    # Coincident waypoints would be edges of length zero, which a sparse graph cannot hold.
    nodes, first, node_of = np.unique(
        unit_points, axis=0, return_index=True, return_inverse=True
    )
    node_of = node_of.reshape(-1)
    edges, gaps = _spanning_forest(nodes)
    pieces = []
    # Every node belongs to one piece: these are its piece, and its number there.
    piece_of, local = np.empty((2, len(nodes)), dtype=np.intp)
    members: list[IntArray] = []
    traced: list[TracedPiece] = []
    for component, local_edges in _components(len(nodes), edges):
        for part, piece in _trace_loops(nodes[component], local_edges, gaps):
            piece_of[component[part]] = len(traced)
            local[component[part]] = np.arange(len(part))
            members.append(component[part])
            traced.append(piece)
    for piece, node, waypoint in zip(
        traced, members, _groups(piece_of[node_of], len(traced)), strict=True
    ):
        pieces.append(_in_cloud(piece, waypoint, local[node_of[waypoint]], first[node], scale))
    # Lengths that agree up to rounding keep the order of their components.
    return tuple(sorted(pieces, key=lambda piece: -round(piece.length / scale, 9)))


def gap_length(spacing: float, num_points: int, chance: float) -> float:
    """Returns the length above which a gap is not an accident of the sampling.

    The gaps of a path sampled at random are exponential, so the 90th percentile is
    ln(10) = 2.3 means, and one of N gaps exceeds log10(N / chance) times that percentile
    with a probability of about `chance`.  With 200 waypoints and 0.01 the factor is 4.3.

    Args:
        spacing: the 90th percentile of the gaps.
        num_points: N.
        chance: the probability to accept.
    """
    return spacing * max(SMALLEST_GAP_FACTOR, float(np.log10(num_points / chance)))


def _to_unit_box(points: FloatArray) -> tuple[FloatArray, float]:
    """Centres and scales to [-1, 1], rounded so that coincident waypoints become equal."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    scale = float((upper / 2 - lower / 2).max()) or 1.0
    unit_points = (points - (lower / 2 + upper / 2)) / scale
    # Adding 0.0 turns -0.0 into 0.0.
    return np.round(unit_points, COINCIDENT_DECIMALS) + 0.0, scale


def _edge_lengths(points: FloatArray, edges: IntArray) -> FloatArray:
    difference: FloatArray = points[edges[:, 0]] - points[edges[:, 1]]
    return np.sqrt((difference**2).sum(axis=1))


def _sparse(points: FloatArray, edges: IntArray) -> csr_array:
    n = len(points)
    entries = (_edge_lengths(points, edges), (edges[:, 0], edges[:, 1]))
    return csr_array(coo_array(entries, shape=(n, n)))


def _shortest_edges(points: FloatArray, edges: IntArray) -> IntArray:
    """Returns the minimum spanning forest of a graph."""
    forest = minimum_spanning_tree(_sparse(points, edges)).tocoo()
    return np.column_stack([forest.row, forest.col]).astype(np.intp)


def _spanning_forest(points: FloatArray) -> tuple[IntArray, _Gaps]:
    """Returns the edges that are not longer than the cut length."""
    n = len(points)
    if n == 1:
        return np.empty((0, 2), dtype=np.intp), _Gaps(0.0, 0.0, 0.0)
    k = min(NEIGHBORS, n - 1)
    neighbors = cKDTree(points).query(points, k=k + 1)[1][:, 1:]
    candidates = np.column_stack([np.repeat(np.arange(n), k), neighbors.reshape(-1)])
    edges = _shortest_edges(points, candidates)
    lengths = _edge_lengths(points, edges)
    spacing = float(np.percentile(lengths, GAP_PERCENTILE))
    cut = gap_length(spacing, n, CUT_CHANCE)
    gaps = _Gaps(spacing, cut, gap_length(spacing, n, CLOSING_CHANCE))
    return _join(points, edges[lengths <= cut], cut), gaps


def _join(points: FloatArray, edges: IntArray, cut: float) -> IntArray:
    """Joins pieces that lie within the cut length of each other (Boruvka's steps).

    Two dense pieces may have all of their nearest neighbours inside themselves, so that
    the neighbour graph misses the edge between them.
    """
    while True:
        count, label = connected_components(_sparse(points, edges), directed=False)
        if count == 1:
            return edges
        distance, foreign = _nearest_foreign(points, label, count, cut)
        by_piece = np.lexsort((distance, label))
        closest = by_piece[np.unique(label[by_piece], return_index=True)[1]]
        closest = closest[np.isfinite(distance[closest])]
        if len(closest) == 0:
            return edges
        bridges = np.column_stack([closest, foreign[closest]])
        edges = _shortest_edges(points, np.concatenate([edges, bridges]))


def _nearest_foreign(
    points: FloatArray, label: IntArray, count: int, cut: float
) -> tuple[FloatArray, IntArray]:
    """Finds the nearest point of another piece, within the cut length, for each point.

    Two labels differ in at least one binary digit, so one pair of trees for each digit
    finds it exactly, however many pieces there are.
    """
    distance = np.full(len(points), np.inf)
    foreign = np.zeros(len(points), dtype=np.intp)
    for bit in range((count - 1).bit_length()):
        side = (label >> bit) & 1 == 1
        for here, there in ((side, ~side), (~side, side)):
            i, j = np.flatnonzero(here), np.flatnonzero(there)
            reach = np.nextafter(cut, np.inf)
            d, nearest = cKDTree(points[j]).query(points[i], distance_upper_bound=reach)
            better = d < distance[i]
            distance[i[better]] = d[better]
            foreign[i[better]] = j[nearest[better]]
    return distance, foreign


def _groups(label: IntArray, count: int) -> list[IntArray]:
    """Returns the ascending positions of each label 0..count-1."""
    by_label = np.argsort(label, kind="stable")
    return np.split(by_label, np.searchsorted(label[by_label], np.arange(1, count)))


def _components(n: int, edges: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Returns the nodes of each component, and its edges in local numbers."""
    ones = np.ones(len(edges))
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    nodes = _groups(label, count)
    local = np.empty(n, dtype=np.intp)
    for node in nodes:
        local[node] = np.arange(len(node))
    of_component = _groups(label[edges[:, 0]], count)
    return [(node, local[edges[edge]]) for node, edge in zip(nodes, of_component, strict=True)]


def _trace_loops(
    points: FloatArray, edges: IntArray, gaps: _Gaps
) -> list[tuple[IntArray, TracedPiece]]:
    """Traces one tree, or the loops that it falls into without its bridges.

    Returns:
        The nodes of each piece, and the piece in local numbers and the unit box.
    """
    piece = _trace(points, edges, gaps.closing)
    whole = [(np.arange(len(points)), piece)]
    if _longest_branch(points, piece) <= BRANCH_FACTOR * gaps.spacing:
        return whole
    return _split_into_loops(points, edges, gaps) or whole


def _split_into_loops(
    points: FloatArray, edges: IntArray, gaps: _Gaps
) -> list[tuple[IntArray, TracedPiece]] | None:
    """Cuts one loop after another off a tree; None if anything else remains."""
    lengths = _edge_lengths(points, edges)
    for edge in np.argsort(-lengths, kind="stable")[:MOST_BRIDGES]:
        if lengths[edge] <= BRIDGE_FACTOR * gaps.spacing:
            break
        halves = _components(len(points), np.delete(edges, edge, axis=0))
        # A gap inside a loop is shorter than the bridge: not so at the tips of a star,
        # whose two sides are neighbours and would pass for loops.
        closing = min(gaps.closing, float(lengths[edge]))
        traced = [_trace(points[nodes], rest, closing) for nodes, rest in halves]
        loop = [
            _is_loop(points[half[0]], piece, gaps)
            for half, piece in zip(halves, traced, strict=True)
        ]
        if not any(loop):
            continue
        parts = []
        for (nodes, rest), piece, is_loop in zip(halves, traced, loop, strict=True):
            more = (
                [(np.arange(len(nodes)), piece)]
                if is_loop
                else _split_into_loops(points[nodes], rest, gaps)
            )
            if more is None:
                return None
            parts += [(nodes[part], piece) for part, piece in more]
        return parts
    return None


def _is_loop(points: FloatArray, piece: TracedPiece, gaps: _Gaps) -> bool:
    enough = len(points) >= LOOP_WAYPOINTS
    return enough and piece.closed and _longest_branch(points, piece) <= gaps.cut


def _longest_branch(points: FloatArray, piece: TracedPiece) -> float:
    """Returns how far a side branch leads from the longest path, along the tree."""
    tree = _sparse(points, piece.edges)
    aside = dijkstra(tree, directed=False, indices=piece.order, min_only=True)
    return float(aside.max())


def _trace(points: FloatArray, edges: IntArray, closing_gap: float) -> TracedPiece:
    """Orders one tree, in local numbers and the unit box."""
    tree = _sparse(points, edges)
    start = int(np.argmax(dijkstra(tree, directed=False, indices=0)))
    from_start, previous = dijkstra(
        tree, directed=False, indices=start, return_predecessors=True
    )
    end = int(np.argmax(from_start))
    path = [end]
    while path[-1] != start:
        path.append(int(previous[path[-1]]))
    order = np.array(path[::-1], dtype=np.intp)
    length = float(from_start[end])
    from_end = dijkstra(tree, directed=False, indices=end)
    closed = _is_closed(points, from_start, from_end, length, closing_gap)
    arc = from_start
    if _runs_backward(points[order], closed):
        order, arc = order[::-1], from_end
    if closed:
        length += float(np.linalg.norm(points[start] - points[end]))
    return TracedPiece(np.arange(len(points)), arc, order, edges, closed, length)


def _is_closed(
    points: FloatArray,
    from_start: FloatArray,
    from_end: FloatArray,
    length: float,
    closing_gap: float,
) -> bool:
    if len(points) < 3:
        return False
    head = points[from_start <= END_SECTION * length]
    tail = points[from_end <= END_SECTION * length]
    gap = float(cKDTree(head).query(tail)[0].min())
    return gap <= closing_gap and length >= CLOSING_RATIO * gap


def _runs_backward(path: FloatArray, closed: bool) -> bool:
    """Whether a path (K, d) runs against the direction of travel of `TracedPiece`."""
    if not closed:
        return tuple(path[-1]) < tuple(path[0])
    centered = path - path.mean(axis=0)
    outer = centered.T @ np.roll(centered, -1, axis=0)
    bivector = (outer - outer.T)[np.triu_indices(path.shape[1], k=1)]
    return bool(bivector[np.argmax(np.abs(bivector))] < 0) if len(bivector) else False


def _in_cloud(
    piece: TracedPiece, waypoint: IntArray, local: IntArray, first: IntArray, scale: float
) -> TracedPiece:
    """Translates a piece from local numbers to waypoints, coincident ones included.

    Args:
        piece: the piece in local numbers and the unit box.
        waypoint: (M,) the waypoints of the piece.
        local: (M,) the local number of each of them.
        first: the first waypoint at each local number.
        scale: length of one unit of the unit box.
    """
    copies = waypoint != first[local]
    copy_edges = np.column_stack([first[local[copies]], waypoint[copies]])
    return TracedPiece(
        indices=waypoint,
        arc=piece.arc[local] * scale,
        order=first[piece.order],
        edges=np.concatenate([first[piece.edges], copy_edges]),
        closed=piece.closed,
        length=piece.length * scale,
    )
