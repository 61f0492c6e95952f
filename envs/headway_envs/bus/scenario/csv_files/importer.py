"""Import of an operator's CSV files as a scenario's tables."""

from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd

from headway.contracts import HeadwayError
from headway_envs.bus.kernel.layout import KNOT_HOURS
from headway_envs.bus.scenario.blocks import chain_at_terminals, terminals
from headway_envs.bus.scenario.csv_files.calls import (
    counts_of_calls,
    drives_of_calls,
    has_counts,
    read_calls,
    trips_of_calls,
)
from headway_envs.bus.scenario.csv_files.files import (
    SOURCE_PREFIX,
    is_there,
    read_file,
    refuse,
    refuse_repeated,
)
from headway_envs.bus.scenario.csv_files.lines import place_calls, read_lines
from headway_envs.bus.scenario.fitted import ALIGHTING_TENTHS, SOURCE, WITHIN_HOUR_SD
from headway_envs.bus.scenario.link_times import smoothed_link_times
from headway_envs.bus.scenario.measures import MAX_SPEED_MPS, distance_m
from headway_envs.bus.scenario.passengers import alighting_shares, spread_by_tenth
from headway_envs.bus.scenario.tables import NO_LINK, PERIOD_HOURS, PERIODS, Tables

_LAST_HOUR = 29
"""Last hour of the day for which boardings are written; later ones are added to it."""
_MAKE = "make demand.csv, or fill boardings and alightings in every row of calls.csv"


def import_csv(folder: Path) -> Tables:
    """Return the tables of the files in `folder`.

    Raises HeadwayError naming file, row and column of a fault.
    """
    if not folder.is_dir():
        raise HeadwayError(f"{folder} is not a folder; give the one that holds stops.csv and lines.csv")
    counted: Counter[str] = Counter()
    lines = read_lines(folder)
    network = _network(folder, lines, counted)
    made_from: dict[str, str] = {}
    meta: dict[str, object] = {
        "source": f"{SOURCE_PREFIX} {folder.resolve().name}",
        "licence": "the operator's",
    }
    if is_there(folder, "calls"):
        if spare := [f"{name}.csv" for name in ("trips", "link_times") if is_there(folder, name)]:
            raise HeadwayError(
                f"{folder}: calls.csv replaces {' and '.join(spare)}; keep them, or it, in another folder"
            )
        calls, dates = read_calls(folder, lines, counted)
        times = _smoothed_times(calls, network, counted)
        trips = trips_of_calls(calls, dates, _link_of_calls(network), times, counted)
        counted["trips that leave before their vehicle arrives from another"] += int(_overlaps(trips).sum())
        meta["dates"] = dates
        made_from["link_times"] = f"calls.csv, {calls['date'].nunique()} days"
    else:
        calls = None
        trips = _planned_trips(folder, lines)
        times = _mean_times(folder, lines, network, trips)
        meta["made_up"] = {"trips": "planned, of trips.csv"}
    if is_there(folder, "demand"):
        counts = _counts(folder, lines)
    elif calls is None or not has_counts(calls):
        raise HeadwayError(f"{folder} has no passenger counts: {_MAKE}")
    else:
        counts = counts_of_calls(calls)
    source = "demand.csv" if is_there(folder, "demand") else "calls.csv"
    made_from |= {f"demand {day}": source for day in counts["daytype"].unique()}
    known = bool(counts["alightings"].notna().all())
    made_from["alighting"] = source if known else f"made up from shares fitted to {SOURCE}"
    return Tables(
        **network,
        link_times=times,
        demand=_demand(counts, trips, counted),
        alighting=_alighting(counts, network["patterns"]),
        trips=_with_vehicles(trips, network),
        meta={
            **meta,
            "made_from": made_from,
            "counted": {name: count for name, count in counted.items() if count},
            "link_times_include_dwell": True,
        },
    )


def _network(folder: Path, lines: pd.DataFrame, counted: Counter[str]) -> dict[str, pd.DataFrame]:
    """Return the tables stops, patterns, pattern_stops and links.

    A link's length is the mean of its distances in lines.csv or, if there are none, the straight line.
    """
    stops = read_file(folder, "stops")
    refuse_repeated("stops", stops, ["stop"], "stop", "names an earlier stop; keep one")
    row = pd.Index(stops["stop"]).get_indexer(pd.Index(lines["stop"]))
    refuse("lines", lines, "stop", row < 0, "is not in stops.csv; add it there or correct it")
    lat, lon = (stops[name].to_numpy()[row] for name in ("lat", "lon"))
    straight = distance_m(np.roll(lat, 1), np.roll(lon, 1), lat, lon)
    inner = lines["seq0"] > 0
    calls = lines[["pattern", "seq0"]].assign(stop=row, before=np.roll(row, 1))
    stated = lines["distance_m"].where(inner).round().groupby([calls["before"], calls["stop"]])
    counted["links of several distances, given their mean"] += int((stated.max() > stated.min()).sum())
    calls["leg_m"] = stated.transform("mean").fillna(pd.Series(straight, lines.index)).clip(lower=1.0).round()
    refuse("lines", lines, "stop", inner & (calls["stop"] == calls["before"]), "follows itself; drop the row")
    short = inner & (lines["distance_m"] < 0.8 * straight - 50.0)  # coordinates are inexact
    problem = "is shorter than the straight line between the stops; give metres, or correct the coordinates"
    refuse("lines", lines, "distance_m", short, problem)
    links = calls[inner].drop_duplicates(["before", "stop"]).reset_index(drop=True)
    ends = pd.MultiIndex.from_frame(links[["before", "stop"]])
    link = ends.get_indexer(pd.MultiIndex.from_frame(calls[["before", "stop"]]))
    first = lines[lines["seq0"] == 0]
    return {
        "stops": pd.DataFrame({"stop": np.arange(len(stops)), "name": stops["stop"].to_numpy()}).assign(
            lat=stops["lat"].to_numpy(), lon=stops["lon"].to_numpy()
        ),
        "patterns": pd.DataFrame(
            {
                "pattern": first["pattern"].to_numpy(),
                "line": first["line"].to_numpy(),
                "dir": first["direction"].to_numpy(),
                "n_stops": lines.groupby("pattern").size().to_numpy(),
            }
        ),
        "pattern_stops": calls[["pattern", "seq0", "stop"]]
        .assign(link=np.where(inner, link, NO_LINK))
        .reset_index(drop=True),
        "links": links[["before", "stop", "leg_m"]]
        .set_axis(["from_stop", "to_stop", "leg_m"], axis=1)
        .assign(link=np.arange(len(links))),
    }


def _planned_trips(folder: Path, lines: pd.DataFrame) -> pd.DataFrame:
    """Return the trips of trips.csv: pattern, vehicle (name), dep_s, arr_s, daytype."""
    trips = place_calls(read_file(folder, "trips"), "trips", lines)
    late = trips["arrival"] < trips["departure"]
    refuse("trips", trips, "arrival", late, "is before the departure; write times after midnight as 24:10")
    names = {"day_type": "daytype", "departure": "dep_s", "arrival": "arr_s"}
    trips = trips.rename(columns=names)[["pattern", "vehicle", "dep_s", "arr_s", "daytype"]]
    refuse("trips", trips, "vehicle", _overlaps(trips), "is still on an earlier trip; name another vehicle")
    return trips


def _overlaps(trips: pd.DataFrame) -> "pd.Series[bool]":
    """Return whether each trip leaves before an earlier one of the same vehicle has arrived."""
    keys = ["daytype", "vehicle"]
    ordered = trips.sort_values(["dep_s", "arr_s"])
    arrived = ordered.assign(latest=ordered.groupby(keys)["arr_s"].cummax()).groupby(keys)["latest"].shift()
    return (ordered["dep_s"] < arrived).reindex(trips.index)


def _with_vehicles(trips: pd.DataFrame, network: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the trips with vehicles numbered by name, or chained at terminals where a name is missing."""
    calls = network["pattern_stops"].groupby("pattern")["stop"]
    first, last = calls.first(), calls.last()
    parts = []
    for _, part in trips.reset_index(drop=True).groupby("daytype", sort=False):
        if part["vehicle"].notna().all():
            vehicle = pd.factorize(part["vehicle"])[0]
        else:
            begin = first.reindex(part["pattern"]).to_numpy(np.int64)
            end = last.reindex(part["pattern"]).to_numpy(np.int64)
            terminal = pd.Series(terminals(network["stops"], np.concatenate((begin, end))))
            ends = {"begin": terminal.reindex(begin).to_numpy(), "end": terminal.reindex(end).to_numpy()}
            vehicle = chain_at_terminals(part.assign(**ends))
        parts.append(part.assign(vehicle=vehicle))
    return pd.concat(parts, ignore_index=True)


def _mean_times(
    folder: Path, lines: pd.DataFrame, network: dict[str, pd.DataFrame], trips: pd.DataFrame
) -> pd.DataFrame:
    """Return the table link_times from the means and standard deviations in link_times.csv."""
    rows = read_file(folder, "link_times")
    number = pd.Series(network["stops"]["stop"].to_numpy(), network["stops"]["name"])
    ends = {
        name: number.reindex(rows[name]).fillna(-1).to_numpy(np.int64) for name in ("from_stop", "to_stop")
    }
    links = network["links"]
    link = pd.MultiIndex.from_frame(links[["from_stop", "to_stop"]]).get_indexer(
        pd.MultiIndex.from_arrays([ends["from_stop"], ends["to_stop"]])
    )
    refuse("link_times", rows, "to_stop", link < 0, "does not follow from_stop in lines.csv; correct it")
    keys = ["day_type", "from_stop", "to_stop", "hour"]
    refuse_repeated("link_times", rows, keys, "hour", "repeats an earlier row; give one mean per hour")
    fast = links["leg_m"].to_numpy()[link] / rows["mean_s"] > MAX_SPEED_MPS
    problem = "is faster than 90 km/h; give seconds, and check the coordinates of both stops"
    refuse("link_times", rows, "mean_s", fast, problem)
    spread = np.sqrt(np.log1p((rows["sd_s"] / rows["mean_s"]) ** 2))  # of a lognormal time
    table = pd.DataFrame(
        {
            "link": link,
            "hour": rows["hour"].astype(np.int64).to_numpy(),
            "log_sigma": np.where(rows["sd_s"].isna(), WITHIN_HOUR_SD, spread),
            "mean_s": rows["mean_s"].to_numpy(),
            "daytype": rows["day_type"].to_numpy(),
        }
    )
    leads = network["pattern_stops"]["link"].to_numpy()
    for day, own in trips.groupby("daytype"):
        usable = (table["daytype"] == day) & table["hour"].isin(KNOT_HOURS)
        timed = np.isin(leads, table.loc[usable, "link"]) | (lines["seq0"] == 0)
        untimed = lines["pattern"].isin(own["pattern"]) & ~timed
        hours = f"for an hour from {KNOT_HOURS[0]} to {KNOT_HOURS[-1]}"
        problem = f"has no time on a {day} from the stop before {hours}; add it to link_times.csv"
        refuse("lines", lines, "stop", untimed, problem)
    return table


def _link_of_calls(network: dict[str, pd.DataFrame]) -> "pd.Series[int]":
    """Return the link that leads to each call, by pattern and seq0."""
    return network["pattern_stops"].set_index(["pattern", "seq0"])["link"]


def _smoothed_times(
    calls: pd.DataFrame, network: dict[str, pd.DataFrame], counted: Counter[str]
) -> pd.DataFrame:
    """Return the table link_times from the recorded drives of each day type."""
    metres = network["links"]["leg_m"].to_numpy(np.float64)
    link = _link_of_calls(network)
    days = calls.groupby("daytype")
    parts = [
        smoothed_link_times(drives_of_calls(own, link, metres, counted), metres, counted).assign(daytype=day)
        for day, own in days
    ]
    return pd.concat(parts, ignore_index=True)


def _counts(folder: Path, lines: pd.DataFrame) -> pd.DataFrame:
    """Return the counts of demand.csv: pattern, seq0, hour, boardings, alightings, daytype.

    Of origin-destination counts, passengers alight in the hour of their boarding.
    """
    rows = place_calls(read_file(folder, "demand"), "demand", lines)
    length = lines.groupby("pattern").size().reindex(rows["pattern"]).to_numpy()
    at_end = (rows["seq0"].to_numpy() == length - 1) & (rows["boardings"] > 0)
    refuse("demand", rows, "boardings", at_end, "board at the last stop of a direction; correct the stop")
    keys = ["day_type", "pattern", "seq0", "hour", "to_stop"]
    refuse_repeated("demand", rows, keys, "hour", "repeats an earlier row; give the mean of a day once")
    rows = rows.rename(columns={"day_type": "daytype"})
    if rows["to_stop"].notna().any():
        refuse("demand", rows, "to_stop", rows["to_stop"].isna(), "is blank; fill it in, or in no row")
        both = rows["alightings"].notna()
        refuse("demand", rows, "alightings", both, "is given beside to_stop; remove one of the columns")
        rows = pd.concat([rows.assign(alightings=0.0), _alightings_of_pairs(rows, lines)])
    elif rows["alightings"].notna().any():
        blank = rows["alightings"].isna()
        refuse("demand", rows, "alightings", blank, "is blank; fill it in")
    return rows[["pattern", "seq0", "hour", "boardings", "alightings", "daytype"]]


def _alightings_of_pairs(rows: pd.DataFrame, lines: pd.DataFrame) -> pd.DataFrame:
    """Return the alightings of origin-destination counts, at the first `to_stop` after the origin."""
    places = lines[["pattern", "stop", "seq0"]].set_axis(["pattern", "to_stop", "to_seq0"], axis=1)
    pairs = rows.reset_index(names="row").merge(places, on=["pattern", "to_stop"])
    reached = pairs[pairs["to_seq0"] > pairs["seq0"]].groupby("row")["to_seq0"].min().reindex(rows.index)
    refuse("demand", rows, "to_stop", reached.isna(), "is not reached after stop in lines.csv; correct it")
    return rows.assign(seq0=reached.astype(np.int64), alightings=rows["boardings"], boardings=0.0)


def _demand(counts: pd.DataFrame, trips: pd.DataFrame, counted: Counter[str]) -> pd.DataFrame:
    """Return the table demand of hours with trips.

    Raises HeadwayError for a day type with trips and without boardings.
    """
    hours = counts["hour"].clip(upper=_LAST_HOUR).astype(np.int64)
    keys = ["daytype", "pattern", "seq0", "hour"]
    table = counts.assign(hour=hours).groupby(keys)["boardings"].sum().reset_index()
    table = table[table["boardings"] > 0]
    running = ["daytype", "pattern"]
    spans = trips.groupby(running).agg(first=("dep_s", "min"), last=("arr_s", "max")) // 3600
    span = spans.reindex(pd.MultiIndex.from_frame(table[running])).to_numpy()
    outside = ~((table["hour"] >= span[:, 0] - 1) & (table["hour"] <= span[:, 1]))
    counted["boardings in hours without trips, left out"] += round(table.loc[outside, "boardings"].sum())
    table = table[~outside]
    for day in trips["daytype"].unique():
        if not (table["daytype"] == day).any():
            raise HeadwayError(f"a {day} has trips but no boardings in their hours: {_MAKE}")
    leaving = trips.assign(hour=trips["dep_s"] // 3600).groupby([*running, "hour"]).size()
    calls = leaving.reindex(pd.MultiIndex.from_frame(table[[*running, "hour"]])).fillna(0)
    return table.assign(calls=calls.to_numpy(np.int64)).rename(columns={"boardings": "board"})


def _alighting(counts: pd.DataFrame, patterns: pd.DataFrame) -> pd.DataFrame:
    """Return the table alighting, from counts or, where there are none, from fitted shares by tenth.

    A period of the day without counts takes the shares of the whole day.
    """
    period = np.searchsorted(PERIOD_HOURS, counts["hour"], side="right")
    kinds = ["boardings", "alightings"]
    sums = counts.assign(period=period).groupby(["pattern", "period", "seq0"])[kinds].sum()
    parts = []
    for pattern, length in zip(patterns["pattern"], patterns["n_stops"], strict=True):
        every = pd.MultiIndex.from_product([[pattern], range(PERIODS), range(length)])
        board, alight = sums.reindex(every).fillna(0.0).to_numpy().T.reshape(2, PERIODS, length)
        if not board.any():
            board = np.ones((PERIODS, length))
        if not alight.any():
            alight = np.outer(board.sum(axis=1), spread_by_tenth(ALIGHTING_TENTHS, np.ones(length)))
        empty = (board.sum(axis=1) == 0) | (alight.sum(axis=1) == 0)
        board[empty], alight[empty] = board.sum(axis=0), alight.sum(axis=0)
        shares = [alighting_shares(*both) for both in zip(board, alight, strict=True)]
        parts.append(
            pd.DataFrame(
                {
                    "pattern": pattern,
                    "seq0": np.tile(np.arange(length), PERIODS),
                    "period": np.repeat(np.arange(PERIODS), length),
                    "p_alight": np.concatenate(shares),
                }
            )
        )
    return pd.concat(parts, ignore_index=True).sort_values(["pattern", "seq0", "period"], ignore_index=True)
