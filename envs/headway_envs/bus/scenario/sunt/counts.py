"""Passengers of SUNT: boardings from trip records or from counts by stop, and alighting shares."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import ALIGHTING_TENTHS, BOARDING_TENTHS
from headway_envs.bus.scenario.passengers import alighting_shares, spread_by_tenth
from headway_envs.bus.scenario.sunt.records import Day
from headway_envs.bus.scenario.tables import PERIOD_HOURS, PERIODS

_PRIOR_LOAD = 30.0
"""Weight, in passengers, of the fitted alighting shares by tenth when they are mixed with a stop's own
share."""
_MIN_RATE = 0.05
"""Minimum boardings per call when a stop's count is divided among its lines, also for unobserved lines."""
LINE_STOP = ["line", "dir", "stop_id"]
"""Columns that identify a stop of a line and direction."""


def demand_from_records(calls: pd.DataFrame, days: Sequence[Day]) -> tuple[pd.DataFrame, float]:
    """Return demand rows for a timetable's calls from trip records, and the number of unassigned boardings.

    Columns: pattern, seq0, hour, calls, board. Boardings are means over `days` at each line, direction, stop
    and hour; they are unassigned if the timetable has no call there in that hour.
    """
    every = pd.concat([day.calls for day in days])
    wanted = every.assign(hour=every["time"] // 3600).groupby([*LINE_STOP, "hour"])["board"].sum() / len(days)
    return _split_over_calls(calls, wanted.reset_index(), [*LINE_STOP, "hour"], None)


def demand_from_stop_counts(
    calls: pd.DataFrame, nodes: pd.DataFrame, rates: "pd.Series[float]"
) -> tuple[pd.DataFrame, float]:
    """Return demand rows for a timetable's calls from stop counts, and the number of unassigned boardings.

    Columns: pattern, seq0, hour, calls, board. Boardings at each stop and hour are divided among its calls in
    proportion to `rates`: mean boardings per call, by line, dir and stop_id, of other days. Unknown lines
    take the stop's mean. Boardings are unassigned if the timetable has no call there in that hour.
    """
    weight = None
    if len(rates):
        keys = pd.MultiIndex.from_frame(calls[LINE_STOP])
        of_stop = rates.groupby("stop_id").mean().reindex(calls["stop_id"]).fillna(float(rates.mean()))
        own = pd.Series(rates.reindex(keys).to_numpy()).fillna(pd.Series(of_stop.to_numpy()))
        weight = np.maximum(own.to_numpy(np.float64), _MIN_RATE)
    return _split_over_calls(calls, nodes, ["stop_id", "hour"], weight)


def _split_over_calls(
    calls: pd.DataFrame, wanted: pd.DataFrame, keys: list[str], weight: NDArray[np.float64] | None
) -> tuple[pd.DataFrame, float]:
    """Divide the boardings of each key among its calls in proportion to their weight.

    Return the rows of demand, and the number of boardings without a call.
    """
    rows = calls[["pattern", "seq0", *LINE_STOP, "hour"]].assign(weight=1.0 if weight is None else weight)
    rows = rows.groupby(["pattern", "seq0", *LINE_STOP, "hour"], as_index=False)["weight"].agg(
        ["sum", "size"]
    )
    rows = rows.merge(wanted, on=keys, how="left").fillna({"board": 0.0})
    share = rows["sum"] / rows.groupby(keys)["sum"].transform("sum")
    board = share * rows["board"]
    lost = float(wanted["board"].sum() - board.sum())
    table = rows[["pattern", "seq0", "hour"]].assign(calls=rows["size"], board=board)
    return table.astype({"hour": np.int64}), lost


def alighting_table(
    network: Mapping[str, pd.DataFrame], days: Sequence[Day]
) -> tuple[pd.DataFrame, list[Day]]:
    """Return the table alighting, and the days it is made from.

    Shares are alightings over the load on arrival at each line, direction, stop and period, mixed with the
    fitted shares where few passengers were observed.
    """
    observed = pd.DataFrame(
        {"alight": [], "load_before": []}, index=pd.MultiIndex.from_tuples([], names=[*LINE_STOP, "period"])
    )
    if days:
        every = pd.concat([day.calls for day in days])
        every = every[every["load_before"].notna()]
        periods = np.searchsorted(PERIOD_HOURS, every["time"] // 3600, side="right")
        observed = (
            every.assign(period=periods).groupby([*LINE_STOP, "period"])[["alight", "load_before"]].sum()
        )
    calls = network["pattern_stops"].merge(network["patterns"][["pattern", "line", "dir"]], on="pattern")
    calls = calls.merge(network["stops"][["stop", "stop_id"]], on="stop").sort_values(["pattern", "seq0"])
    prior = calls.groupby("pattern")["seq0"].transform(lambda rows: _prior(len(rows)))
    parts = []
    for period in range(PERIODS):
        keys = pd.MultiIndex.from_frame(calls[LINE_STOP].assign(period=period))
        own = observed.reindex(keys).fillna(0.0)
        share = (own["alight"].to_numpy() + _PRIOR_LOAD * prior.to_numpy()) / (
            own["load_before"].to_numpy() + _PRIOR_LOAD
        )
        parts.append(
            pd.DataFrame(
                {
                    "pattern": calls["pattern"].to_numpy(),
                    "seq0": calls["seq0"].to_numpy(),
                    "period": period,
                    "p_alight": np.clip(share, 0.0, 1.0),
                }
            )
        )
    table = pd.concat(parts, ignore_index=True).sort_values(["pattern", "seq0", "period"], ignore_index=True)
    last = table["seq0"] == table.groupby("pattern")["seq0"].transform("max")
    table.loc[last, "p_alight"] = 1.0
    table.loc[table["seq0"] == 0, "p_alight"] = 0.0
    return table, list(days)


def _prior(count: int) -> NDArray[np.float64]:
    """Return the fitted alighting shares of a pattern of `count` stops."""
    even = np.ones(count)
    return alighting_shares(spread_by_tenth(BOARDING_TENTHS, even), spread_by_tenth(ALIGHTING_TENTHS, even))
