"""Streets of a synthetic town, and the routes of its lines, which share stops and links."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import LINK_M_LOGNORMAL, STOPS_GAMMA

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SITES_PER_HUB = 45
"""Assumption: number of pairs of stops per hub, a place where lines end."""
ASPECT_RATIO = 3.0
"""Assumption: length of the town's rectangle over its width. Salvador lies along its coast."""
_WEIGHT_SD = 0.5
"""Assumption: sd of the log of a street's weight in path finding, which keeps paths from being straight."""
_JITTER = 0.3
"""Largest distance of a site outside its cell, in cells. It gives the log of link lengths an sd of about 0.54
(fitted: 0.64)."""
_MAX_MEDIANS = 3.0
"""Assumption: links longer than this many medians are streets only where no other link connects."""
_CANDIDATES = 12
"""Number of candidate paths through a hub; the one that passes the fewest sites twice is taken."""


@dataclass(frozen=True)
class LineLayout:
    """Positions of the stops, and the stops of each line in both directions.

    One-way lines have a single pattern.
    """

    x: Floats
    """(S,) distance to the east, m"""
    y: Floats
    """(S,) distance to the north, m"""
    lines: tuple[tuple[Integers, ...], ...]
    """Per line one or two patterns, each the stops (n,) in order"""


@dataclass(frozen=True)
class _PathTree:
    """Best paths from one hub to all sites."""

    before: Integers
    """(sites,) previous site on the path from the hub; negative at the hub"""
    hops: Integers
    """(sites,) number of links from the hub"""

    def path(self, site: int) -> list[int]:
        """Return the sites from the hub to `site`, including both."""
        found = [site]
        while self.before[found[-1]] >= 0:
            found.append(int(self.before[found[-1]]))
        return found[::-1]


def lay_out_lines(
    rng: np.random.Generator, sites: int, one_way: list[bool], limits: tuple[int, int]
) -> LineLayout:
    """Lay out one line per element of `one_way`, on streets between `sites` pairs of stops.

    A pair is one stop on each side of the street. Lines begin at hubs. The number of stops of a pattern is
    drawn from the fitted gamma distribution, again until it lies within `limits`. The town is scaled so that
    the log of its link lengths has the fitted mean.
    """
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
    """Return positions (sites,), each in or near its own grid cell, so that few sites lie close together."""
    rows = round((sites / ASPECT_RATIO) ** 0.5)
    columns = -(-sites // rows)
    cell = np.sort(rng.choice(rows * columns, sites, replace=False))
    off_x, off_y = rng.uniform(-_JITTER, 1.0 + _JITTER, (2, sites))
    return np.asarray(cell // rows + off_x, np.float64), np.asarray(cell % rows + off_y, np.float64)


def _draw_stop_count(rng: np.random.Generator, limits: tuple[int, int]) -> int:
    """Draw the number of stops of a pattern within `limits`."""
    while True:
        count = 2 + round(rng.gamma(*STOPS_GAMMA))
        if limits[0] <= count <= limits[1]:
            return count


def _link_lengths(x: Floats, y: Floats, stops: Integers) -> Floats:
    """Return the lengths of the links between consecutive stops."""
    return np.asarray(np.hypot(np.diff(x[stops]), np.diff(y[stops])), np.float64)


def _shortest_paths(rng: np.random.Generator, x: Floats, y: Floats, hubs: Integers) -> list[_PathTree]:
    """Draw streets and their weights, and return the tree of best paths from each hub."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import Delaunay

    corners = Delaunay(np.column_stack((x, y))).simplices
    edges = np.unique(
        np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])), axis=0
    )
    length = np.hypot(x[edges[:, 0]] - x[edges[:, 1]], y[edges[:, 0]] - y[edges[:, 1]])
    # Long edges along the hull are no streets; those of the spanning tree keep every site connected.
    tree = minimum_spanning_tree(coo_array((length, edges.T), shape=(len(x), len(x)))).tocoo()
    kept = (length < _MAX_MEDIANS * np.median(length)) | np.isin(
        edges @ [len(x), 1], tree.row * len(x) + tree.col
    )
    edges, length = edges[kept], length[kept]
    # A constant per link: without it, paths of many short links would be as good as those of few long ones.
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
    """Draw a site that is `hops` links away from the hub, or as close to that as possible."""
    off = np.abs(tree.hops - max(hops, 1)) + (tree.hops == 0) * len(tree.hops)
    return int(rng.choice(np.flatnonzero(off == off.min())))


def _path_through_hub(rng: np.random.Generator, tree: _PathTree, count: int) -> list[int]:
    """Return a path of about `count` sites that begins at the hub.

    If no site is that far away, the path leads through the hub instead.
    """
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
