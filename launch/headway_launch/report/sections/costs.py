"""Sections on cost: energy, CO2 and CPU seconds, and rewards against them."""

from headway.stats import frames, plots
from headway.wording import counted
from headway_launch.console.number_formats import formatted, scale_of, with_deviation
from headway_launch.report.elements import Part, Picture, Section, table_by_task
from headway_launch.report.study_data import StudyData

_POWER_MODES = {"energy.cpu": "CPU", "energy.gpu": "GPU", "energy.ram": "RAM"}
_PARTS = ("cpu_kwh", "gpu_kwh", "ram_kwh")
NOT_MEASURED = (
    "Energy was not measured for these runs (`energy=off`, or CodeCarbon gave no reading). CPU seconds, "
    "which the operating system counts, are in the table of runs."
)


def energy_section(data: StudyData) -> Section:
    """Return the section with energy, CPU seconds and, if the country is known, CO2 per controller."""
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
        of_cell, total = costs.loc[(task, controller)], sums.loc[(task, controller)]
        co2 = with_deviation(of_cell["kg_co2"] * co2_factor, of_cell["kg_co2_std"] * co2_factor)
        labels.append(f"{controller}{data.where(task).replace(' on ', ', ')}")
        rows.append(
            [
                task,
                controller,
                str(int(of_cell["runs"])),
                with_deviation(of_cell["kwh"] * kwh_factor, of_cell["kwh_std"] * kwh_factor),
                *([co2] if emitted else []),
                with_deviation(of_cell["cpu_seconds"], of_cell["cpu_seconds_std"]),
                *(formatted(of_cell[part] * kwh_factor) for part in _PARTS),
                formatted(total["kwh"] * kwh_factor),
                formatted(total["cpu_seconds"]),
            ]
        )
    body: list[Part] = [
        _power_sources(data),
        "The session's energy is divided among its runs by their use; idle energy and that of the session "
        "itself are assigned to no run. Seeds trained together in a stack get equal shares. Only finished "
        "runs are included; tuning and failed runs used additional energy.",
    ]
    without_country = int(used["kg_co2"][known].isna().sum())
    if 0 < without_country < int(known.sum()):
        body.append(
            f"{counted(without_country, 'run')} had no `energy.country`: CO2 is given only for controllers "
            "with a country in all runs."
        )
    if not known.all():
        without = int((~known).sum())
        body.append(f"{counted(without, 'run')} had no measurement and are excluded from these means.")
    body.append(
        table_by_task(
            data.tasks,
            "energy",
            f"{title} and CPU seconds per run, mean ± standard deviation over seeds, and totals over all "
            "seeds.",
            [
                "controller",
                "seeds",
                f"{kwh_unit} per run",
                *([f"{co2_unit} CO2eq per run"] if emitted else []),
                "CPU s per run",
                f"CPU, {kwh_unit}",
                f"GPU, {kwh_unit}",
                f"RAM, {kwh_unit}",
                f"all seeds, {kwh_unit}",
                "all seeds, CPU s",
            ],
            rows,
            costs.reset_index(),
        )
    )
    panels = (["CO2"] if emitted else []) + ["energy by component", "CPU seconds"]
    named = ", ".join(f"({letter}) {panel}" for letter, panel in zip("abc", panels, strict=False))
    body.append(
        Picture(
            "footprint",
            f"Cost per run: {named}; means over seeds, whiskers show one standard deviation.",
            plots.footprint(costs.set_axis(labels, axis="index"), units),
        )
    )
    return Section("energy", title, body)


def tradeoff_section(data: StudyData) -> Section:
    """Return the section with reward against energy, one point per run; CPU seconds if energy is unknown."""
    reward = f"{data.metric_label[0].upper()}{data.metric_label[1:]}"
    runs = data.scores.join(data.summaries[["kwh", "cpu_seconds"]])
    known = runs[runs["kwh"].notna()]
    body: list[Part] = []
    if len(known):
        unit, factor = scale_of(float(known["kwh"].max()), "kWh")
        points, cost, label, title = known, "kwh", f"{unit} per run", f"{reward} against energy"
    else:
        body.append("Energy was not measured, so CPU seconds are shown instead.")
        points, cost, factor, label = runs[runs["cpu_seconds"].notna()], "cpu_seconds", 1.0, "CPU s per run"
        title = f"{reward} against CPU seconds"
    if not len(points):
        return Section("tradeoff", f"{reward} against cost", ["Neither energy nor CPU seconds are known."])
    picture = plots.reward_against_cost(
        points, cost, factor, (label, f"final {data.metric_with_unit}"), data.styles, data.sign
    )
    caption = (
        f"Final {data.metric_label} against cost per run: one dot per seed, a ring at each controller's mean."
    )
    body.append(Picture("reward_against_cost", caption, picture))
    return Section("tradeoff", title, body)


def _power_sources(data: StudyData) -> str:
    """Describe the source of each component's power, and the country whose energy mix is used."""
    from headway_launch.studies.runs import configuration

    used = data.summaries[data.summaries["kwh"].notna()]
    sources = []
    for column, part in _POWER_MODES.items():
        modes = [str(mode) for mode in used[column].dropna().unique()] if column in used else []
        sources.append(f"{part} {' or '.join(modes) or 'unknown'}")
    countries = {configuration(row.directory)["energy"]["country"] for row in data.runs.rows}
    named = ", ".join(sorted(country for country in countries if country is not None))
    mix = f"CO2 with the energy mix of {named}" if named else "no CO2, as no energy.country is set"
    return (
        f"Measured by CodeCarbon, offline; {mix}. Source of the power values: {'; '.join(sources)}. An "
        "estimate from the processor's name or load may be far from a metered value; CPU seconds are "
        "counted by the operating system and shown beside the energy."
    )
