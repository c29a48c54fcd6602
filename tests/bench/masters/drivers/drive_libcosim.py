"""libcosim: its fixed-step algorithm, with an observer that keeps time series in memory."""

import time

import protocol
from libcosimpy._internal import get_last_error_message
from libcosimpy.CosimEnums import CosimVariableType
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

U = 0
Y = 1


def main() -> None:
    """Run."""
    task = protocol.task()
    if task["method"] != "cs":
        protocol.refuse("it is for co-simulation")
    steps = task["steps"]
    execution = CosimExecution.from_step_size(step_size=task["step_ns"])
    observer = CosimObserver.create_time_series(buffer_size=steps + 1)
    execution.add_observer(observer=observer)
    slaves = []
    indices = []
    for lag in task["lags"]:
        slave = CosimLocalSlave(fmu_path=lag["fmu"], instance_name=lag["name"])
        if not slave.ptr():
            protocol.refuse(get_last_error_message().split(" for FMU")[0])
        slaves.append(slave)
        indices.append(execution.add_local_slave(local_slave=slave))
    for index, lag in zip(indices, task["lags"], strict=True):
        if lag["source"] is not None:
            execution.connect_real_variables(indices[lag["source"]], Y, index, U)
        for variable in (U, Y):
            observer.start_time_series(index, variable, CosimVariableType.REAL)
    execution.step(1)  # its first step initializes
    began = time.process_time()
    execution.step(steps - 1)
    seconds = time.process_time() - began
    columns = []
    for index in indices:
        _, numbers, values = observer.time_series_real_samples(
            index, Y, from_step=1, sample_count=steps
        )
        columns.append(dict(zip(numbers, values, strict=True)))
    samples = []
    for sample in task["samples"]:
        samples.append((sample, [column[sample] for column in columns]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
