"""The structs of ``model_exchange.h``: an FMU for model exchange with its solver."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_void_p
from typing import Final

import numpy as np

from cosim.native.fmi.fmu import VariablesStruct

STATE_EVENT: Final = 1  # COSIM_STATE_EVENT
STEP_EVENT: Final = 2
TIME_EVENT: Final = 4
INPUT_EVENT: Final = 8
NOT_LISTED: Final = 16

AT_BEGIN: Final = 0  # COSIM_AT_BEGIN
INTEGRATING: Final = 1
AT_END: Final = 2

FAILED_CALL: Final = 1  # COSIM_FAILED_CALL
FAILED_SOLVER: Final = 2
FAILED_INPUTS: Final = 3
ENDLESS_UPDATE: Final = 4
EVENT_IS_OVER: Final = 5


EVENT: Final = np.dtype([("t", np.float64), ("kind", np.int32), ("count", np.int32)])
"""cosim_event."""


class ModelExchangeStruct(Structure):
    """cosim_model_exchange."""

    _fields_ = (
        *((name, c_void_p) for name in ("fmu", "solver")),
        *((name, c_void_p) for name in ("set_time", "set_states", "get_states")),
        *((name, c_void_p) for name in ("get_derivatives", "get_indicators", "completed_step")),
        *((name, c_void_p) for name in ("enter_event_mode", "update")),
        *((name, c_void_p) for name in ("enter_continuous_time_mode", "get_state", "set_state")),
        ("input_variables", VariablesStruct),
        ("continuous_variables", VariablesStruct),
        ("output_variables", VariablesStruct),
        *((name, c_int32) for name in ("n_x", "n_z", "n_u", "n_in_events", "parts")),
        ("longest_step", c_double),
        ("in_events", c_void_p),
        *((name, c_int32) for name in ("allowed", "rolls_back")),
        ("fmu_state", c_void_p),
        *((name, c_int32) for name in ("moved", "due", "ended", "nominals_changed")),
        *((name, c_double) for name in ("t", "next_event", "inputs_time")),
        *((name, c_void_p) for name in ("x", "inputs", "indicators", "nominals")),
        *((name, c_int32) for name in ("reached", "failure", "handled")),
        ("since", c_double),
        ("events", c_void_p),
        *((name, c_int32) for name in ("n_events", "room", "in_step")),
        *((name, c_double) for name in ("latest", "first", "t0", "t1")),
        *((name, c_void_p) for name in ("u0", "u1", "end_inputs", "u", "scratch")),
        ("left", c_void_p),
        ("has_left", c_int32),
    )
