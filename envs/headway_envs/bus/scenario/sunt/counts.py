"""Passengers of SUNT: boardings by trip record or by stop, and the shares that alight."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from headway_envs.bus.scenario.fitted import ALIGHTING_TENTHS, BOARDING_TENTHS
from headway_envs.bus.scenario.passengers import alighting_shares, spread_by_tenth
from headway_envs.bus.scenario.sunt.records import Day
from headway_envs.bus.scenario.tables import PERIOD_HOURS, PERIODS

_PRIOR_LOAD = 30.0
"""Passengers' worth of the measured shares by tenth that a stop's own share of alightings is mixed with."""
_MIN_RATE = 0.05
"""Boardings of a call at a stop where none were seen, in splitting a stop's count over its lines."""
LINE_STOP = ["line", "dir", "stop_id"]


def demand_from_records(calls: pd.DataFrame, days: Sequence[Day]) -> tuple[pd.DataFrame, float]:
    """Rows of demand (pattern, seq0, hour, calls, board) of a timetable's calls, by the mean boardings of
    `days` at each line, direction, stop and hour; and the boardings that found no call there then."""
    every = pd.concat([day.calls for day in days])
    wanted = every.assign(hour=every["time"] // 3600).groupby([*LINE_STOP, "hour"])["board"].sum() / len(days)
    return _split_over_calls(calls, wanted.reset_index(), [*LINE_STOP, "hour"], None)


def demand_from_stop_counts(
    calls: pd.DataFrame, nodes: pd.DataFrame, rates: "pd.Series[float]"
) -> tuple[pd.DataFrame, float]:
    """The same by boardings at each stop and hour, split over what calls there by calls times the `rates` of
    other days (mean boardings of a call by line, dir and stop_id; at unknown ones the stop's mean)."""
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
    """Boardings of each key shared among its calls by their weight."""
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
    """The table alighting, and the days it is made of: alightings over the load on arrival at each line,
    direction, stop and period, mixed with the measured shares where few were seen."""
    seen = pd.DataFrame(
        {"alight": [], "load_before": []}, index=pd.MultiIndex.from_tuples([], names=[*LINE_STOP, "period"])
    )
    if days:
        every = pd.concat([day.calls for day in days])
        every = every[every["load_before"].notna()]
        periods = np.searchsorted(PERIOD_HOURS, every["time"] // 3600, side="right")
        seen = every.assign(period=periods).groupby([*LINE_STOP, "period"])[["alight", "load_before"]].sum()
    calls = network["pattern_stops"].merge(network["patterns"][["pattern", "line", "dir"]], on="pattern")
    calls = calls.merge(network["stops"][["stop", "stop_id"]], on="stop").sort_values(["pattern", "seq0"])
    prior = calls.groupby("pattern")["seq0"].transform(lambda rows: _prior(len(rows)))
    parts = []
    for period in range(PERIODS):
        keys = pd.MultiIndex.from_frame(calls[LINE_STOP].assign(period=period))
        own = seen.reindex(keys).fillna(0.0)
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
    even = np.ones(count)
    return alighting_shares(spread_by_tenth(BOARDING_TENTHS, even), spread_by_tenth(ALIGHTING_TENTHS, even))
