"""Sections on what it cost: energy, CO2, CPU seconds, and what was reached for them."""

from headway.stats import frames, plots
from headway.stats.plots import counted
from headway_launch.report.parts import (
    Part,
    Picture,
    Section,
    Table,
    figure,
    scale_of,
    with_deviation,
)
from headway_launch.report.study_data import StudyData

_MODES = {"energy.cpu": "CPU", "energy.gpu": "GPU", "energy.ram": "RAM"}
_PARTS = ("cpu_kwh", "gpu_kwh", "ram_kwh")
NOT_MEASURED = (
    "Energy was not measured for these runs (`energy=off`, or CodeCarbon gave no reading), so there is none "
    "to report. CPU seconds, which the system counts, are in the table of runs."
)


def energy_section(data: StudyData) -> Section:
    """kWh, CPU seconds and, where the country is known, CO2 per controller, and the picture of them."""
    used = data.summaries
    known = used["kwh"].notna()
    if not known.any():
        return Section("energy", "Energy", [NOT_MEASURED])
    costs = frames.costs(data.runs.summaries())
    emitted = bool(costs["kg_co2"].notna().any())
    title = "Energy and CO2" if emitted else "Energy"
    kwh_unit, kwh_factor = scale_of(float(used["kwh"].max()), "kWh")
    co2_unit, co2_factor = scale_of(float(used["kg_co2"].max()), "kg") if emitted else ("kg", 1.0)
    units = {"kwh": (kwh_unit, kwh_factor)} | ({"kg_co2": (co2_unit, co2_factor)} if emitted else {})
    sums = used[known].groupby(["task", "controller"])[["kwh", "cpu_seconds"]].sum()
    rows, labels = [], []
    for task, controller in costs.index:
        of_cell, whole = costs.loc[(task, controller)], sums.loc[(task, controller)]
        co2 = with_deviation(of_cell["kg_co2"] * co2_factor, of_cell["kg_co2_std"] * co2_factor)
        labels.append(f"{controller}{data.where(task).replace(' on ', ', ')}")
        rows.append(
            [
                *([task] if len(data.tasks) > 1 else []),
                controller,
                str(int(of_cell["runs"])),
                with_deviation(of_cell["kwh"] * kwh_factor, of_cell["kwh_std"] * kwh_factor),
                *([co2] if emitted else []),
                with_deviation(of_cell["cpu_seconds"], of_cell["cpu_seconds_std"]),
                *(figure(of_cell[part] * kwh_factor) for part in _PARTS),
                figure(whole["kwh"] * kwh_factor),
                figure(whole["cpu_seconds"]),
            ]
        )
    body: list[Part] = [
        _how_known(data),
        "The session's energy is shared out to runs by what they used; what the machine used idle, and for "
        "the session itself, is no run's. A seed of a stack has an equal share of it. Only finished runs "
        "are counted here: tuning and failed runs used energy beside it.",
    ]
    without_country = int(used["kg_co2"][known].isna().sum())
    if 0 < without_country < int(known.sum()):
        body.append(
            f"{counted(without_country, 'run')} had no `energy.country`: CO2 is given where all runs of a "
            "controller had one."
        )
    if not known.all():
        without = int((~known).sum())
        body.append(f"{counted(without, 'run')} had no measurement and are left out of the means here.")
    body.append(
        Table(
            "energy",
            f"{title} and CPU seconds of a run, mean ± standard deviation over seeds, and sums over them.",
            [
                *(["environment"] if len(data.tasks) > 1 else []),
                "controller",
                "seeds",
                f"{kwh_unit} a run",
                *([f"{co2_unit} CO2eq a run"] if emitted else []),
                "CPU s a run",
                f"CPU, {kwh_unit}",
                f"GPU, {kwh_unit}",
                f"RAM, {kwh_unit}",
                f"all seeds, {kwh_unit}",
                "all seeds, CPU s",
            ],
            rows,
            costs.reset_index(),
            words=frozenset(range(2 if len(data.tasks) > 1 else 1)),
        )
    )
    panels = (["CO2"] if emitted else []) + ["energy by part of the machine", "CPU seconds"]
    named = ", ".join(f"({letter}) {panel}" for letter, panel in zip("abc", panels, strict=False))
    body.append(
        Picture(
            "footprint",
            f"What a run cost: {named}; means over seeds, whiskers one standard deviation.",
            plots.footprint(costs.set_axis(labels, axis="index"), units),
        )
    )
    return Section("energy", title, body)


def tradeoff_section(data: StudyData) -> Section:
    """Reward against energy, a point a run; against CPU seconds where energy was not measured."""
    runs = data.scores.join(data.summaries[["kwh", "cpu_seconds"]])
    known = runs[runs["kwh"].notna()]
    body: list[Part] = []
    if len(known):
        unit, factor = scale_of(float(known["kwh"].max()), "kWh")
        drawn, cost, label = known, "kwh", f"{unit} a run"
    else:
        body.append("Energy was not measured: CPU seconds stand in for it here.")
        drawn, cost, factor, label = runs[runs["cpu_seconds"].notna()], "cpu_seconds", 1.0, "CPU s a run"
    if not len(drawn):
        return Section("tradeoff", "Reward against energy", ["Neither energy nor CPU seconds are known."])
    picture = plots.reward_against_cost(
        drawn, cost, factor, (label, f"final {data.what}"), data.styles, data.sign
    )
    caption = f"Final {data.what} over what the run cost: a dot a seed, a ring at each controller's mean."
    body.append(Picture("reward_against_energy", caption, picture))
    return Section("tradeoff", f"{data.what[0].upper()}{data.what[1:]} against energy", body)


def _how_known(data: StudyData) -> str:
    """How the power of each part is known, and of which country the mix is."""
    from headway_launch.studies.runs import configuration

    used = data.summaries[data.summaries["kwh"].notna()]
    told = []
    for column, part in _MODES.items():
        modes = [str(mode) for mode in used[column].dropna().unique()] if column in used else []
        told.append(f"{part} {' or '.join(modes) or 'unknown'}")
    countries = {configuration(row.directory)["energy"]["country"] for row in data.runs.rows}
    named = ", ".join(sorted(country for country in countries if country is not None))
    mix = f"CO2 with the energy mix of {named}" if named else "no CO2, as no energy.country is set"
    return (
        f"By CodeCarbon, offline; {mix}. How the power is known: "
        f"{'; '.join(told)}. An estimate from the processor's name or load may be far from what a meter "
        "shows; CPU seconds are counted by the system and stand beside it."
    )
