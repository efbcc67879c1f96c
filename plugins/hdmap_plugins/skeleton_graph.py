"""From a mask of thin areas to lines of cells: skeleton, graph, spurs cut, junctions resolved."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import networkx as nx
import numpy as np
from scipy import ndimage

from hdmap_tools.geometry.polyline import arc_lengths
from hdmap_tools.types import NDArrayBool, NDArrayFloat


@dataclass(frozen=True)
class CellLine:
    """A line through cell centres.

    Attributes:
        xy_cells: (N, 2) column and row; first and last equal for a ring.
        at_junction: Whether the first and the last point lie at a junction with
            another line, which goes on there.
    """

    xy_cells: NDArrayFloat
    at_junction: tuple[bool, bool]


def skeleton_lines(
    mask: NDArrayBool, *, spur_factor: float, max_deflection_deg: float
) -> list[CellLine]:
    """The centre lines of a mask.

    Args:
        mask: (y, x) bool.
        spur_factor: A branch that ends freely and is shorter than this many times
            the mask's width at its root is a bump of the outline, not a line.
        max_deflection_deg: At a junction the two branches that continue one another
            best, within this angle, become one line; the others end there.
    """
    from skimage.morphology import skeletonize

    if not mask.any():
        return []
    # A margin, because the border is treated differently. Lee, because the default
    # (Zhang) erases diagonal lines two cells wide.
    skeleton = skeletonize(np.pad(mask, 1), method="lee")[1:-1, 1:-1] > 0
    half_width = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    graph = _branch_graph(skeleton)
    _cut_spurs(graph, half_width, spur_factor)
    _merge_near_junctions(graph, half_width, spur_factor)
    lines = _resolve_junctions(graph, max_deflection_deg)
    return [piece for line in lines for piece in _split_at_corners(line)]


def _branch_graph(skeleton: NDArrayBool) -> nx.MultiGraph[Any]:
    """Nodes are free ends and junctions (clusters of cells), edges carry the ``path`` between them."""
    cells = [(int(r), int(c)) for r, c in np.argwhere(skeleton)]
    present = set(cells)
    pixels: nx.Graph[Any] = nx.Graph()
    pixels.add_nodes_from(cells)
    for r, c in cells:
        for dr, dc in ((0, 1), (1, 0)):
            if (r + dr, c + dc) in present:
                pixels.add_edge((r, c), (r + dr, c + dc))
        for dc in (-1, 1):
            # A diagonal beside a corner cell would make a triangle of three junctions.
            if (
                (r + 1, c + dc) in present
                and (r + 1, c) not in present
                and (r, c + dc) not in present
            ):
                pixels.add_edge((r, c), (r + 1, c + dc))

    crossing = sorted(n for n in pixels if pixels.degree(n) >= 3)
    cluster: dict[tuple[int, int], tuple[int, int]] = {}
    graph: nx.MultiGraph[Any] = nx.MultiGraph()
    for group in sorted(sorted(g) for g in nx.connected_components(pixels.subgraph(crossing))):
        centre = np.mean(group, axis=0)
        graph.add_node(group[0], xy=(float(centre[1]), float(centre[0])))
        cluster.update(dict.fromkeys(group, group[0]))
    for n in sorted(pixels):
        if pixels.degree(n) <= 1:
            cluster[n] = n
            graph.add_node(n, xy=(float(n[1]), float(n[0])))

    walked: set[frozenset[tuple[int, int]]] = set()

    def walk(start: tuple[int, int], following: tuple[int, int]) -> list[tuple[int, int]]:
        path = [start, following]
        walked.add(frozenset(path))
        while path[-1] not in cluster and path[-1] != start:
            onward = sorted(m for m in pixels[path[-1]] if m != path[-2])
            path.append(onward[0])
            walked.add(frozenset(path[-2:]))
        return path

    for n in sorted(cluster):
        for m in sorted(pixels[n]):
            if frozenset((n, m)) in walked or cluster.get(m) == cluster[n]:
                continue
            path = walk(n, m)
            _add_branch(graph, cluster[n], cluster[path[-1]], path)
    # What is left are rings without any junction.
    for n in sorted(pixels):
        if n in cluster or any(frozenset((n, m)) in walked for m in pixels[n]):
            continue
        path = walk(n, min(pixels[n]))
        graph.add_node(n, xy=(float(n[1]), float(n[0])))
        _add_branch(graph, n, n, path)
    return graph


def _add_branch(graph: nx.MultiGraph[Any], a: Any, b: Any, path: list[tuple[int, int]]) -> None:
    xy = np.array([(c, r) for r, c in path], dtype=np.float64)
    xy[0], xy[-1] = graph.nodes[a]["xy"], graph.nodes[b]["xy"]
    graph.add_edge(a, b, path=xy, start=a)


def _oriented(data: dict[str, Any], start: Any) -> NDArrayFloat:
    path: NDArrayFloat = data["path"]
    return path if data["start"] == start else path[::-1]


def _cut_spurs(graph: nx.MultiGraph[Any], half_width: NDArrayFloat, factor: float) -> None:
    """Remove short free branches, shortest first, and heal the nodes that are left with two."""
    while True:
        spurs = []
        for a, b, key, data in graph.edges(keys=True, data=True):
            for end, root in ((a, b), (b, a)):
                if graph.degree(end) == 1 and graph.degree(root) >= 3:
                    length = float(arc_lengths(data["path"])[-1])
                    if length < factor * _width_at(graph, root, half_width):
                        spurs.append((length, end, root, key))
        if not spurs:
            return
        for _, end, root, key in sorted(spurs):
            # An earlier cut may have made a through line of this one.
            if not graph.has_edge(end, root, key) or graph.degree(root) < 3:
                continue
            graph.remove_edge(end, root, key)
            graph.remove_node(end)
            if graph.degree(root) == 2:
                _heal(graph, root)


def _width_at(graph: nx.MultiGraph[Any], node: Any, half_width: NDArrayFloat) -> float:
    col, row = np.floor(np.array(graph.nodes[node]["xy"]) + 0.5).astype(int)
    return 2.0 * float(half_width[row, col])


def _merge_near_junctions(
    graph: nx.MultiGraph[Any], half_width: NDArrayFloat, factor: float
) -> None:
    """Make one junction of two that are joined by a short branch.

    The skeleton of two crossing lines is two forks with a bridge between them.
    """
    while True:
        bridges = []
        for a, b, data in graph.edges(data=True):
            if a != b and graph.degree(a) >= 3 and graph.degree(b) >= 3:
                length = float(arc_lengths(data["path"])[-1])
                widths = _width_at(graph, a, half_width), _width_at(graph, b, half_width)
                if length < factor * max(widths):
                    bridges.append((length, min(a, b), max(a, b)))
        if not bridges:
            return
        touched: set[Any] = set()
        for _, a, b in sorted(bridges):
            # Nodes that changed are looked at again in the next round.
            if a in touched or b in touched:
                continue
            touched |= {a, b} | set(graph[a]) | set(graph[b])
            if _is_rung(graph, a, b):
                while graph.has_edge(a, b):
                    graph.remove_edge(a, b)
                for node in (a, b):
                    if graph.degree(node) == 2:
                        _heal(graph, node)
            else:
                _contract(graph, a, b)


def _contract(graph: nx.MultiGraph[Any], a: Any, b: Any) -> None:
    """Move node b, with all its branches, into node a; the new place is half way."""
    xy = np.mean([graph.nodes[a]["xy"], graph.nodes[b]["xy"]], axis=0)
    graph.nodes[a]["xy"] = (float(xy[0]), float(xy[1]))
    while graph.has_edge(a, b):
        graph.remove_edge(a, b)
    for _, other, data in list(graph.edges(b, data=True)):
        path = _oriented(data, b).copy()
        if other == b:
            path[-1] = xy
        graph.add_edge(a, a if other == b else other, path=path, start=a)
    graph.remove_node(b)
    for _, other, data in graph.edges(a, data=True):
        path = data["path"]
        if other == a:
            path[[0, -1]] = xy
        else:
            path[0 if data["start"] == a else -1] = xy


def _is_rung(graph: nx.MultiGraph[Any], a: Any, b: Any) -> bool:
    """Whether the bridge between two nodes stands across the lines there, as between double lines."""
    bridge = np.subtract(graph.nodes[b]["xy"], graph.nodes[a]["xy"])
    bridge = bridge / max(float(np.hypot(*bridge)), 1e-12)
    for node in (a, b):
        for _, other, data in graph.edges(node, data=True):
            if {node, other} == {a, b}:
                continue
            heading = _heading_along(_oriented(data, node))
            if abs(float(heading @ bridge)) > 0.5:
                return False
    return True


def _heal(graph: nx.MultiGraph[Any], node: Any) -> None:
    """Replace a node with two branches by one branch; a ring keeps its node."""
    ends = list(graph.edges(node, keys=True, data=True))
    if len(ends) != 2:
        return
    (_, a, key_a, data_a), (_, b, key_b, data_b) = ends
    path = np.vstack([_oriented(data_a, node)[::-1], _oriented(data_b, node)[1:]])
    graph.remove_edge(node, a, key_a)
    graph.remove_edge(node, b, key_b)
    graph.remove_node(node)
    graph.add_edge(a, b, path=path, start=a)


def _resolve_junctions(graph: nx.MultiGraph[Any], max_deflection_deg: float) -> list[CellLine]:
    """Lines that run straight on through junctions."""
    # Half-edges: (branch, end); joined holds the partner that continues each.
    branches = [
        (u, v, data)
        for u, v, _, data in sorted(
            graph.edges(keys=True, data=True), key=lambda e: (e[3]["path"].tolist(), e[2])
        )
    ]
    at_node: dict[Any, list[tuple[int, int]]] = {}
    for index, (u, v, data) in enumerate(branches):
        first, last = (u, v) if data["start"] == u else (v, u)
        at_node.setdefault(first, []).append((index, 0))
        at_node.setdefault(last, []).append((index, 1))

    joined: dict[tuple[int, int], tuple[int, int]] = {}
    is_junction: dict[tuple[int, int], bool] = {}
    for node in sorted(at_node):
        ends = at_node[node]
        is_ring = len(ends) == 2 and ends[0][0] == ends[1][0]
        for end in ends:
            is_junction[end] = len(ends) > 1 and not is_ring
        turns = sorted(
            (_deflection_deg(_heading(branches, p), _heading(branches, q)), p, q)
            for p, q in combinations(ends, 2)
            if p[0] != q[0]
        )
        for turn, p, q in turns:
            if turn <= max_deflection_deg and p not in joined and q not in joined:
                joined[p], joined[q] = q, p

    result = []
    used: set[int] = set()
    starts = [(i, e) for i in range(len(branches)) for e in (0, 1) if (i, e) not in joined]
    starts += [(i, 0) for i in range(len(branches))]  # rings of branches have no free end
    for start in starts:
        if start[0] in used:
            continue
        pieces: list[NDArrayFloat] = []
        at = start
        while True:
            used.add(at[0])
            path: NDArrayFloat = branches[at[0]][2]["path"]
            path = path if at[1] == 0 else path[::-1]
            pieces.append(path[1:] if pieces else path)
            out = (at[0], 1 - at[1])
            following = joined.get(out)
            if following is None or following[0] in used:
                break
            at = following
        xy = np.vstack(pieces)
        if len(xy) >= 2:
            result.append(CellLine(xy, (is_junction[start], is_junction[out])))
    return result


def _heading(branches: list[Any], end: tuple[int, int]) -> NDArrayFloat:
    path: NDArrayFloat = branches[end[0]][2]["path"]
    return _heading_along(path if end[1] == 0 else path[::-1])


def _heading_along(path: NDArrayFloat) -> NDArrayFloat:
    """Direction in which a path leaves its first point, over its first dozen cells."""
    chord: NDArrayFloat = path[min(len(path) - 1, 12)] - path[0]
    return chord / max(float(np.hypot(*chord)), 1e-12)


def _deflection_deg(leaving: NDArrayFloat, other: NDArrayFloat) -> float:
    """0 when the two branches are one straight line."""
    return float(np.degrees(np.arccos(np.clip(-leaving @ other, -1.0, 1.0))))


def _split_at_corners(line: CellLine, reach: int = 6, corner_deg: float = 50.0) -> list[CellLine]:
    """Pieces between sharp bends: smoothing would round them, and no lane mark has any.

    They come from the corners of parking bays, and where the ends of two parallel
    lines touch. A ring is cut open there too: around the slit between two parallel
    lines it is no ring but both of them. One of a few cells is a hole in the mask.
    """
    xy = line.xy_cells
    is_ring = bool(np.all(xy[0] == xy[-1]))
    if len(xy) < 2 * reach + 1:
        return [] if is_ring else [line]
    if is_ring and not any(line.at_junction):
        ring = xy[:-1]
        turn = _turns_deg(np.vstack([ring[-reach:], ring, ring[:reach]]), reach)
        if turn.max() <= corner_deg:
            return [line]
        ring = np.roll(ring, -int(np.argmax(turn)), axis=0)
        xy = np.vstack([ring, ring[:1]])
    turn = _turns_deg(xy, reach)
    cuts = []
    while turn.size and turn.max() > corner_deg:
        worst = int(np.argmax(turn))
        cuts.append(worst + reach)
        turn[max(worst - reach, 0) : worst + reach + 1] = 0.0
    bounds = [0, *sorted(cuts), len(xy) - 1]
    return [
        CellLine(
            xy[a : b + 1],
            (line.at_junction[0] and a == 0, line.at_junction[1] and b == len(xy) - 1),
        )
        for a, b in pairwise(bounds)
        if b > a
    ]


def _turns_deg(xy: NDArrayFloat, reach: int) -> NDArrayFloat:
    """Bend (N - 2 reach,) at each point that has so many on both sides, 0..180."""
    before, after = xy[reach:-reach] - xy[: -2 * reach], xy[2 * reach :] - xy[reach:-reach]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    dot = np.einsum("nk,nk->n", before, after)
    return np.asarray(np.abs(np.degrees(np.arctan2(cross, dot))))
