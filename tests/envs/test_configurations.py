"""Arguments that no environment can have are refused by their name."""

from math import inf, nan
from typing import Any

import pytest

import headway_envs.bus.config as bus
import headway_envs.bus_published.config as published
import headway_envs.intersection.config as intersection
import headway_envs.junctions.config as junctions
import headway_envs.merge.config as merge
from headway_envs.toy.matrix import MatrixConfig
from headway_envs.toy.recall import RecallConfig
from headway_envs.toy.tracking import TrackingConfig
from headway_envs.toy.trivial import TrivialConfig
from headway_envs.toy.visitors import VisitorsConfig

NO_WEIGHTS = dict.fromkeys(("service", "efficiency", "maintenance", "regularity"), 0.0)
NO_PUBLISHED_WEIGHTS = dict.fromkeys(("occupancy", "uptime", "regularity", "efficiency"), 0.0)


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (bus.BusConfig, {"capacity": 0}, "capacity"),
        (bus.BusConfig, {"tick_s": 7.0}, "must divide the service day"),
        (bus.BusConfig, {"start_hour": 24}, "must hold, not 24 and 24; such as start_hour=5 end_hour=24"),
        (bus.BusConfig, {"captive_share": 1.5}, "captive_share"),
        (bus.BusConfig, {"control": "second"}, "control must be minute or holding, not 'second'"),
        (bus.BusConfig, {"max_hold_s": 90.0}, "max_hold_s has no effect with control=minute"),
        (bus.BusConfig, {"control": "holding", "hold_s": 30.0}, "hold_s has no effect with control=holding"),
        (bus.BusConfig, {"control": "holding", "hold_levels": 1}, "hold_levels must be 0, or 2 to 1000"),
        (bus.BusConfig, {"control": "holding", "control_every": 0}, "control_every must be at least 1"),
        (bus.RewardConfig, NO_WEIGHTS, "at least one of the weights"),
        (bus.NoiseConfig, {"trip_sd": -0.1}, "trip_sd"),
        (bus.UpkeepConfig, {"uptime_hours": 0.0}, "uptime_hours"),
        (published.BusPublishedConfig, {"agents": 0}, "agents must be at least 1, not 0"),
        (published.BusPublishedConfig, {"start_hour": 24}, "0 <= start_hour < end_hour <= 24 must hold"),
        (published.BusPublishedConfig, {"centre": -1}, "centre must be null or at least 0, not -1"),
        (published.BusPublishedConfig, {"observation": "all"}, "must be scaled or raw, not 'all'"),
        (published.BusPublishedConfig, {"day_type": "monday"}, "day_type must be weekday or sunday"),
        (published.BusPublishedConfig, {"max_steps": 0}, "max_steps must be at least 1"),
        (published.BusPublishedConfig, {"scenario": ""}, "scenario must name line, corridor, district, city"),
        (published.BusPublishedConfig, {"scenario_seed": -1}, "scenario_seed must be at least 0"),
        (published.RewardConfig, {"uptime": -1.0}, "uptime must be at least 0, not -1"),
        (published.RewardConfig, NO_PUBLISHED_WEIGHTS, "at least one of the weights"),
        (published.RewardConfig, {"low_occupancy": 0.95}, "0 < low_occupancy < high_occupancy < 1 must hold"),
        (published.RewardConfig, {"target_headway_s": 0}, "target_headway_s must be above 0, not 0"),
        (merge.MergeConfig, {"density": 4}, "density must be 1, 2 or 3, not 4"),
        (merge.MergeConfig, {"preset": "modern"}, "preset must be clean or paper, not 'modern'"),
        (merge.MergeConfig, {"cavs": 0}, "cavs must be null or between 1 and 6, not 0"),
        (merge.MergeConfig, {"cavs": 7}, "cavs must be null or between 1 and 6, not 7"),
        (merge.MergeConfig, {"steps": 0}, "steps must be at least 1, not 0"),
        (merge.RewardConfig, {"scope": "team"}, "scope must be global, regional or own, not 'team'"),
        (merge.RewardConfig, {"collision": -1.0}, "collision must be at least 0, not -1"),
        (merge.RewardConfig, {"headway_s": 0.0}, "headway_s must be above 0, not 0"),
        (
            intersection.IntersectionConfig,
            {"junction": "x"},
            "must be one of priority, right_before_left, al",
        ),
        (intersection.IntersectionConfig, {"observation": "all"}, "observation must be one of paper, extend"),
        (intersection.IntersectionConfig, {"action_repeat": 0}, "action_repeat must be at least 1"),
        (intersection.IntersectionConfig, {"action_repeat": 61, "horizon": 60}, "most horizon, 60, not 61"),
        (intersection.IntersectionConfig, {"vph_per_lane_av": 0}, "vph_per_lane_av must be above 0"),
        (intersection.IntersectionConfig, {"vph_per_lane_hdv": -1}, "vph_per_lane_hdv must be at least 0"),
        (intersection.IntersectionConfig, {"vph_per_lane_hdv": 1e6}, "lane_hdv must be at most 3,600"),
        (intersection.IntersectionConfig, {"vph_per_lane_av": inf}, "lane_av must be at most 3,600"),
        (intersection.IntersectionConfig, {"impatience": 2.0}, "impatience must lie between 0 and 1, not 2"),
        (intersection.IntersectionConfig, {"horizon": 0}, "horizon must be at least 1"),
        (intersection.IntersectionConfig, {"av_speed_mode": 128}, "av_speed_mode must lie between 0 and 127"),
        (
            intersection.IntersectionConfig,
            {"on_collision": "warn"},
            "must be one of remove_pair, end_episode",
        ),
        (intersection.IntersectionConfig, {"at_exit": "done"}, "must be one of truncated, terminated"),
        (intersection.RewardConfig, {"kind": "paper", "scope": "own"}, "scope=own is for kind=scaled"),
        (
            junctions.JunctionsConfig,
            {"demand": "0x700"},
            "demand must have numbers between 1 and 3,600, not '0x",
        ),
        (junctions.JunctionsConfig, {"network": ""}, "network must not be empty"),
        (
            junctions.JunctionsConfig,
            {"network": "my.net.xml"},
            "demand must be a route file .* not '700x700'",
        ),
        (junctions.JunctionsConfig, {"automated_share": 0.0}, "automated_share must lie in .0, 1., not 0.0"),
        (junctions.JunctionsConfig, {"step_s": 0.0}, "step_s must lie in .0, 10., not 0.0"),
        (junctions.JunctionsConfig, {"lead_in_s": -1}, "lead_in_s must be at least 0, not -1"),
        (junctions.JunctionsConfig, {"approaches": 1}, "approaches must be at least 2, not 1"),
        (junctions.JunctionsConfig, {"hdv_speed_mode": 128}, "hdv_speed_mode must lie between 0 and 127"),
        (TrivialConfig, {"agents": 0}, "agents must be at least 1, not 0"),
        (TrivialConfig, {"steps": 0}, "steps must be at least 1, not 0"),
        (MatrixConfig, {"payoff": ((1.0, 2.0),)}, "as many columns as rows"),
        (MatrixConfig, {"payoff": ((nan,),)}, "finite"),
        (TrackingConfig, {"effort": -1.0}, "effort must be within 0 and 10, not -1.0"),
        (TrackingConfig, {"noise": 0.5}, "noise must be within 0 and 0.1, not 0.5"),
        (VisitorsConfig, {"steps": 1}, "steps must be at least 2, not 1"),
        (RecallConfig, {"agents": 0}, "agents must be at least 1, not 0"),
        (RecallConfig, {"steps": 1}, "steps must be at least 2, not 1"),
        (RecallConfig, {"cues": 1}, "cues must be at least 2, not 1"),
    ],
)
def test_impossible_arguments_are_refused(config: type, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config(**values)
