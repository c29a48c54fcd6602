"""The structures of FMI 1.0 and 2.0 that are handed over to an FMU."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int, c_int8, c_void_p


class Fmi1CallbackFunctions(Structure):
    """fmiCallbackFunctions of co-simulation; model exchange has the first three."""

    _fields_ = (
        ("logger", c_void_p),
        ("allocateMemory", c_void_p),
        ("freeMemory", c_void_p),
        ("stepFinished", c_void_p),
    )


class Fmi1EventInfo(Structure):
    """fmiEventInfo."""

    _fields_ = (
        ("iterationConverged", c_int8),
        ("stateValueReferencesChanged", c_int8),
        ("stateValuesChanged", c_int8),
        ("terminateSimulation", c_int8),
        ("upcomingTimeEvent", c_int8),
        ("nextEventTime", c_double),
    )


class Fmi2CallbackFunctions(Structure):
    """fmi2CallbackFunctions."""

    _fields_ = (
        ("logger", c_void_p),
        ("allocateMemory", c_void_p),
        ("freeMemory", c_void_p),
        ("stepFinished", c_void_p),
        ("componentEnvironment", c_void_p),
    )


class Fmi2EventInfo(Structure):
    """fmi2EventInfo."""

    _fields_ = (
        ("newDiscreteStatesNeeded", c_int),
        ("terminateSimulation", c_int),
        ("nominalsOfContinuousStatesChanged", c_int),
        ("valuesOfContinuousStatesChanged", c_int),
        ("nextEventTimeDefined", c_int),
        ("nextEventTime", c_double),
    )
