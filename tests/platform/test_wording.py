"""Wording: metrics in words, with the unit that their description states."""

import pytest

from headway.registry import env_entries
from headway.wording import readable_metric, spans


@pytest.mark.parametrize(
    ("environment", "metric", "said"),
    [
        ("bus", "mean_wait_min", "mean wait, min"),
        ("bus", "held_min_per_trip", "held per trip, min"),
        ("bus", "headway_cv", "headway cv"),
        ("merge", "min_gap_m", "min gap, m"),
        ("merge", "mean_speed_ms", "mean speed, m/s"),
        ("intersection", "outflow_warm_vph", "outflow warm, per hour"),
        ("intersection", "speed_av", "speed av, m/s"),
        ("intersection", "travel_time_av_s", "travel time av, s"),
        ("intersection", "fuel_gal_s", "fuel, gallons/s"),
    ],
)
def test_a_metric_is_named_with_the_unit_of_its_description(environment: str, metric: str, said: str) -> None:
    assert readable_metric(metric, env_entries()[environment].metrics[metric]) == said


def test_every_metric_whose_name_ends_in_a_unit_states_it_in_its_description() -> None:
    for environment in ("bus", "bus_published", "merge", "intersection", "junctions"):
        for metric, description in env_entries()[environment].metrics.items():
            if metric.rpartition("_")[2] in ("min", "s", "m", "ms", "vph"):
                assert ", " in readable_metric(metric, description), (environment, metric)


def test_a_description_without_a_unit_leaves_the_name() -> None:
    assert readable_metric("queue_m", "length of the queue, in vehicles") == "queue m"


def test_consecutive_seeds_are_a_range() -> None:
    assert spans([0, 1, 2, 3, 7]) == "0..3,7"
    assert spans([4, 5]) == "4,5"
    assert spans([3, 2, 1]) == "3,2,1"
