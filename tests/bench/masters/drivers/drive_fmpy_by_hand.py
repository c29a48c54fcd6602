"""FMPy: one step of all FMUs with its classes; an input is given, an output is read."""

import time

import protocol
from drive_fmpy import NO_SOURCE, Lag, U, Y


def main():
    """Run."""
    task = protocol.task()
    lags = [Lag(lag, task["fmi_version"], "cs") for lag in task["lags"]]
    h = task["step_ns"] / 1e9
    values = [1e-6 * k for k in range(task["steps"])]
    y = [NO_SOURCE] * len(lags)
    began = time.process_time()
    for k, value in enumerate(values):
        t = k * h
        for i, lag in enumerate(lags):
            lag.set(U, [y[lag.source] if i else value])
            lag.fmu.doStep(t, h)
            y[i] = lag.get(Y)[0]
    seconds = time.process_time() - began
    protocol.report(seconds, [(task["steps"], [y[-1]])])


if __name__ == "__main__":
    main()
