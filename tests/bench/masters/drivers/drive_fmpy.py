"""FMPy: its classes in a loop over lists; every input is the newest output there is."""

import ctypes
import time

import protocol
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave

CLASSES = {
    ("2", "cs"): FMU2Slave,
    ("3", "cs"): FMU3Slave,
    ("2", "me"): FMU2Model,
    ("3", "me"): FMU3Model,
}
U = [0]
Y = [1]
NO_SOURCE = 0.0


class Lag:
    """An instance behind one set of names for both versions."""

    def __init__(self, lag, version, interface_type):
        description = read_model_description(lag["fmu"])
        entry = description.coSimulation or description.modelExchange
        self.source = lag["source"]
        self.fmu = CLASSES[version, interface_type](
            guid=description.guid,
            unzipDirectory=extract(lag["fmu"]),
            modelIdentifier=entry.modelIdentifier,
            instanceName=lag["name"],
        )
        fmu = self.fmu
        fmu.instantiate()
        if version == "2":
            fmu.setupExperiment(startTime=0.0)
            self.set = fmu.setReal
            self.get = fmu.getReal
        else:
            self.set = fmu.setFloat64
            self.get = fmu.getFloat64
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        if interface_type == "me":
            self._begin(version)

    def _begin(self, version):
        fmu = self.fmu
        if version == "2":
            fmu.newDiscreteStates()
            self._slopes = fmu.getDerivatives
        else:
            fmu.updateDiscreteStates()
            self._slopes = fmu.getContinuousStateDerivatives
        fmu.enterContinuousTimeMode()
        self._x = (ctypes.c_double * 1)()
        self._k = (ctypes.c_double * 1)()
        fmu.getContinuousStates(self._x, 1)

    def slope(self, t, x):
        """Return x' at t."""
        self.fmu.setTime(t)
        self._x[0] = x
        self.fmu.setContinuousStates(self._x, 1)
        self._slopes(self._k, 1)
        return self._k[0]

    def rk4(self, t, h):
        """Take a step of the classic Runge-Kutta method."""
        x = self._x[0]
        k1 = self.slope(t, x)
        k2 = self.slope(t + 0.5 * h, x + 0.5 * h * k1)
        k3 = self.slope(t + 0.5 * h, x + 0.5 * h * k2)
        k4 = self.slope(t + h, x + h * k3)
        self._x[0] = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.fmu.setContinuousStates(self._x, 1)
        self.fmu.completedIntegratorStep()


def main():
    """Run."""
    task = protocol.task()
    if task["method"] not in ("cs", "rk4"):
        protocol.refuse(f"its classes have no {task['method']}")
    lags = [Lag(lag, task["fmi_version"], task["interface_type"]) for lag in task["lags"]]
    steps = task["steps"]
    h = task["step_ns"] / 1e9
    co_simulation = task["interface_type"] == "cs"
    began = time.process_time()
    rows = [[lag.get(Y)[0] for lag in lags]]
    inputs = []
    for k in range(steps):
        t = k * h
        y = list(rows[-1])
        u = []
        for i, lag in enumerate(lags):
            value = NO_SOURCE if lag.source is None else y[lag.source]
            u.append(value)
            lag.set(U, [value])
            if co_simulation:
                lag.fmu.doStep(t, h)
            else:
                lag.rk4(t, h)
            y[i] = lag.get(Y)[0]
        rows.append(y)
        inputs.append(u)
    seconds = time.process_time() - began
    protocol.report(seconds, [(sample, rows[sample]) for sample in task["samples"]])


if __name__ == "__main__":
    main()
