"""How the components of a scenario advance, as tables."""

from __future__ import annotations

from cosim.report.schedule import GraphSchedule, ScheduledComponent, ScheduledStage
from cosim.report.tables.console import new_table, print_json, print_tables


def print_schedule(schedule: GraphSchedule, *, as_json: bool) -> None:
    """Print stages, components and connections."""
    if as_json:
        print_json(schedule.to_dict())
        return
    title = f"{schedule.scenario}: stages in order, communication step {schedule.step:g} s"
    table = new_table(title, ("", "components", "advance"))
    for stage in schedule.stages:
        table.add_row(str(stage.number), ", ".join(stage.members), stage_text(stage))
    tables = [table]
    table = new_table("components", ("", "stage", "kind", "outputs change", "direct feedthrough"))
    for component in schedule.components:
        table.add_row(
            component.name,
            str(component.stage),
            component.kind,
            component.rate,
            feedthrough_text(component),
        )
    tables.append(table)
    table = new_table("connections", ("from", "to", "within a step"))
    for connection in schedule.connections:
        table.add_row(connection.source, connection.to, COURSES[connection.course])
    print_tables([*tables, table])


COURSES = {
    "linear": "linear interpolation",
    "linear over period": "linear interpolation over its period",
    "mean": "mean of both ends",
    "latest": "latest value, which may have jumped",
    "zero-order hold": "zero-order hold",
    "sampled": "zero-order hold of its samples",
    "delayed": "delayed, so its value at the start of the step is exact",
    "extrapolated": "extrapolated: held from the start of the step",
    "solved": "solved",
}


def stage_text(stage: ScheduledStage) -> str:
    """Return how the components of a stage advance."""
    if not stage.coupling:
        return "in blocks of steps"
    text = f"step by step, {stage.coupling}: {', '.join(stage.operations)}"
    if stage.solved:
        text += f"; solved in every step: {', '.join(stage.solved)}"
    if stage.is_first_order:
        text += "; coupling error: first order"
    if stage.shortest_substep is not None:
        some = len(stage.substeps) < len(stage.members)
        names = f"{', '.join(stage.substeps)} " if some else ""
        text += f"; {names}in substeps of at least {stage.shortest_substep:g} s"
    return text


def feedthrough_text(component: ScheduledComponent) -> str:
    """Return on which inputs the outputs of a component depend directly."""
    texts = []
    without = []
    for output, inputs in component.feedthrough.items():
        if inputs is None:
            texts.append(f"{output}: not known")
        elif inputs:
            texts.append(f"{output} from {' '.join(inputs)}")
        else:
            without.append(output)
    if not texts:
        return "none"
    if without:
        texts.append(f"none: {' '.join(without)}")
    return ", ".join(texts)
