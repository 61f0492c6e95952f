"""Streets of a synthetic town and the ways of its lines, which share stops and links."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import LINK_M_LOGNORMAL, STOPS_GAMMA

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SITES_PER_HUB = 45
"""Assumption: one place where lines end for so many pairs of stops."""
ASPECT_RATIO = 3.0
"""Assumption: the sides of the town's rectangle, one to the other; Salvador lies along its coast."""
_WEIGHT_SD = 0.5
"""Assumption: sd of the log of a street's weight in looking for ways, so that these are no straight lines."""
_JITTER = 0.3
"""Cells that a place may lie beyond its own: with this the log of links' lengths has an sd of about 0.54
(fitted: 0.64)."""
_MAX_MEDIANS = 3.0
"""Assumption: longer links than this many medians are streets only where nothing else leads on."""
_CANDIDATES = 12
"""Ends drawn for a way through a hub; the one with the least of its way driven twice is taken."""


@dataclass(frozen=True)
class LineLayout:
    """Where stops lie, and the stops of each line there and, but for one-way lines, back."""

    x: Floats
    """(S,) m to the east"""
    y: Floats
    """(S,) m to the north"""
    lines: tuple[tuple[Integers, ...], ...]
    """Of each line one or two patterns: the stops (n,)"""


@dataclass(frozen=True)
class _PathTree:
    """The best ways from one hub to everywhere."""

    before: Integers
    """(sites,) the site before on the way from the hub; negative at the hub"""
    hops: Integers
    """(sites,) links from the hub"""

    def path(self, site: int) -> list[int]:
        """The sites from the hub to `site`, both with them."""
        found = [site]
        while self.before[found[-1]] >= 0:
            found.append(int(self.before[found[-1]]))
        return found[::-1]


def lay_out_lines(
    rng: np.random.Generator, sites: int, one_way: list[bool], limits: tuple[int, int]
) -> LineLayout:
    """Lines, one for each of `one_way`, on streets between `sites` pairs of stops, one on each side.

    Lines begin at hubs; the stops of a pattern are drawn from the fitted gamma, again until they lie within
    `limits`. The town is scaled so that the log of its links' lengths has the fitted mean."""
    x, y = _scatter_sites(rng, sites)
    hubs = rng.choice(sites, max(sites // SITES_PER_HUB, 2), replace=False)
    out, back = (_shortest_paths(rng, x, y, hubs) for _ in range(2))
    lines: list[tuple[Integers, ...]] = []
    for goes_one_way in one_way:
        hub = int(rng.integers(len(hubs)))
        count = _draw_stop_count(rng, limits)
        if goes_one_way:
            half = out[hub].path(_site_at_distance(rng, out[hub], count // 2))
            home = back[hub].path(half[-1])[::-1]
            lines.append((np.array([2 * s for s in half] + [2 * s + 1 for s in home[1:]]),))
        else:
            path = np.array(_path_through_hub(rng, out[hub], count))
            lines.append((2 * path, 2 * path[::-1] + 1))
    place_x, place_y = np.repeat(x, 2), np.repeat(y, 2)
    legs = np.concatenate([_link_lengths(place_x, place_y, stops) for line in lines for stops in line])
    metres = float(np.exp(LINK_M_LOGNORMAL[0] - np.log(legs[legs > 0]).mean()))
    aside = np.tile((10.0, -10.0), sites)
    return LineLayout(place_x * metres + aside, place_y * metres + aside, tuple(lines))


def _scatter_sites(rng: np.random.Generator, sites: int) -> tuple[Floats, Floats]:
    """Places (sites,), each in or about its cell of a grid, so that not too many lie near to each other."""
    rows = round((sites / ASPECT_RATIO) ** 0.5)
    columns = -(-sites // rows)
    cell = np.sort(rng.choice(rows * columns, sites, replace=False))
    off_x, off_y = rng.uniform(-_JITTER, 1.0 + _JITTER, (2, sites))
    return np.asarray(cell // rows + off_x, np.float64), np.asarray(cell % rows + off_y, np.float64)


def _draw_stop_count(rng: np.random.Generator, limits: tuple[int, int]) -> int:
    while True:
        count = 2 + round(rng.gamma(*STOPS_GAMMA))
        if limits[0] <= count <= limits[1]:
            return count


def _link_lengths(x: Floats, y: Floats, stops: Integers) -> Floats:
    return np.asarray(np.hypot(np.diff(x[stops]), np.diff(y[stops])), np.float64)


def _shortest_paths(rng: np.random.Generator, x: Floats, y: Floats, hubs: Integers) -> list[_PathTree]:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import Delaunay

    corners = Delaunay(np.column_stack((x, y))).simplices
    edges = np.unique(
        np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])), axis=0
    )
    length = np.hypot(x[edges[:, 0]] - x[edges[:, 1]], y[edges[:, 0]] - y[edges[:, 1]])
    # No streets run along the hull; the tree keeps every site within reach.
    tree = minimum_spanning_tree(coo_array((length, edges.T), shape=(len(x), len(x)))).tocoo()
    kept = (length < _MAX_MEDIANS * np.median(length)) | np.isin(
        edges @ [len(x), 1], tree.row * len(x) + tree.col
    )
    edges, length = edges[kept], length[kept]
    # A bit more than its length each: without that, many short links would be no longer than few long ones.
    weight = (length + np.median(length)) * rng.lognormal(0.0, _WEIGHT_SD, len(edges))
    graph = coo_array((weight, (edges[:, 0], edges[:, 1])), shape=(len(x), len(x))).tocsr()
    metres, before = dijkstra(graph, directed=False, indices=hubs, return_predecessors=True)
    trees = []
    for hub, far, last in zip(hubs, metres, before, strict=True):
        hops = np.zeros(len(x), np.int64)
        for site in np.argsort(far):
            if site != hub:
                hops[site] = hops[last[site]] + 1
        trees.append(_PathTree(last.astype(np.int64), hops))
    return trees


def _site_at_distance(rng: np.random.Generator, tree: _PathTree, hops: int) -> int:
    """A site so many links from the hub, or as near to that as there is."""
    off = np.abs(tree.hops - max(hops, 1)) + (tree.hops == 0) * len(tree.hops)
    return int(rng.choice(np.flatnonzero(off == off.min())))


def _path_through_hub(rng: np.random.Generator, tree: _PathTree, count: int) -> list[int]:
    """A way of about `count` sites that begins at the hub or, where none is so long, leads through it."""
    longest = int(tree.hops.max())
    if count - 1 <= longest:
        return tree.path(_site_at_distance(rng, tree, count - 1))
    first = max(count - 1 - longest, (count - 1) // 3)
    best: list[int] = []
    twice = len(tree.hops)
    for _ in range(_CANDIDATES):
        one = tree.path(_site_at_distance(rng, tree, first))
        other = tree.path(_site_at_distance(rng, tree, count - 1 - first))
        shared = len(set(one) & set(other))
        if shared < twice:
            best, twice = one[::-1] + other[1:], shared
    return best
