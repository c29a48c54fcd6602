"""A scenario, and recordings of its plant and its command that another tool wrote."""

from __future__ import annotations

import numpy as np

from tests.log.foreign_files import EPOCH, write_json

STEP = 1e-2
STEP_NS = 10_000_000
STOP = 3.0
COUNT = 400

LOOP = """
scenario = { name = "loop", stop = 3.0, step = 1e-2 }
[components]
command = { kind = "sine", amplitude = 2.0, rate = 3.0 }
plant = { kind = "lag", time_constant = 0.5 }
double = { kind = "gain", K = 2.0 }
model = { kind = "lag", time_constant = 0.5 }
error = { kind = "sum", signs = [1, -1] }

[connections]
"plant.u" = "command.y"
"model.u" = "command.y"
"double.u" = "command.y"
"error.u1" = "plant.y"
"error.u2" = "model.y"
"""


def level(t):
    return np.cos(1.7 * t) + t


def command(t):
    return np.sin(5.0 * t) - 1.0


def field_log(folder, *, shift_ns=3_000_000, step_ns=STEP_NS, count=COUNT, name="field.mcap"):
    """Write two topics on the wall clock, of which the second begins ``shift_ns`` later."""
    state = []
    cmd = []
    for index in range(-50, count):
        time_ns = index * step_ns
        state.append((EPOCH + time_ns, {"position": level(time_ns / 1e9), "name": "x"}))
    for index in range(count):
        time_ns = shift_ns + index * step_ns
        row = {"values": [command(time_ns / 1e9), 7.0], "stamp": (EPOCH + time_ns) / 1e9}
        cmd.append((EPOCH + time_ns, row))
    return write_json(folder / name, {"/drive/state": state, "/cmd": cmd})


PLANT = {"plant.y": "/drive/state.position"}
BOTH = {**PLANT, "plant.u": "/cmd.values[0]"}
