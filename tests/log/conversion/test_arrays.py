"""Logs as NPZ and MAT files, read back bit for bit by numpy and scipy."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.io.matlab import MatWriteError

from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import UsageError
from cosim.log.conversion import convert
from cosim.log.text import LogChoice
from tests.log.recordings import STEP_NS, same_bits

SLICES = {
    "plant.u": (slice(0, 1), 1),
    "plant.x_a": (slice(1, 3), 1),
    "plant.der(x)": (slice(3, 4), 1),
    "plant.n": (slice(4, 5), 1),
    "identifier.y": (slice(5, 8), 5),
    "identifier.theta": (slice(8, 10), 5),
}


def expected(rows, name):
    columns, period = SLICES[name]
    return rows[::period, columns]


def test_npz_reads_back_bit_for_bit(recorded, tmp_path):
    """Every signal with the instants of its component, without pickles."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as read:
        assert set(read) == {"signals", "t:plant", "t:identifier", *log}
        for name in log:
            assert same_bits(read[name].reshape(len(read[name]), -1), expected(rows, name))
            assert same_bits(read[name], log[name])
        assert same_bits(read["t:identifier"], log.time("identifier"))
        about = json.loads(str(read["signals"]))
    assert list(about) == list(log)
    assert about["plant.u"]["unit"] == "m/s"
    assert about["plant.x_a"] == {"role": "state", "variability": "continuous", "type": "real"}


def test_equal_logs_give_equal_npz_files(recorded, tmp_path):
    """No date of today is in them."""
    log, _ = recorded
    convert(LogChoice.of(log), tmp_path / "a.npz")
    convert(LogChoice.of(log), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_mat_reads_back_bit_for_bit(recorded, tmp_path):
    """Under names that MATLAB allows, with the names of the log beside them."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat", chars_as_strings=True)
    entries = read["signals"]
    assert entries.shape == (6, 1)
    originals = [str(entry["name"].item()) for entry in entries[:, 0]]
    assert originals == list(log)
    for entry, name in zip(entries[:, 0], originals, strict=True):
        variable = str(entry["variable"].item())
        assert variable.isidentifier()
        assert variable.isascii()
        assert same_bits(read[variable], expected(rows, name))
        times = read[str(entry["time"].item())]
        assert same_bits(times[:, 0], log.time(name))
    assert str(entries[0, 0]["unit"].item()) == "m/s"
    assert entries[1, 0]["unit"].size == 0
    assert str(entries[2, 0]["variable"].item()) == "plant_der_x_"


def test_names_that_are_no_variables_stay_apart(tmp_path):
    """Long ones too, those that begin with a digit, and those that the file has itself."""
    stem = "n" * 70
    names = ["a b", "a_b", "a.b", f"{stem}1", f"{stem}2", "ü"]
    interface = Interface((), tuple(Signal(name) for name in names))
    others = Interface((), (Signal("1"),))
    channels = (
        Channel("1", interface, 0),
        Channel("t", others, len(names)),
        Channel("t_1", others, len(names) + 1),
    )
    plan = Plan(Layout(channels), STEP_NS, {}, {}, ())
    with Memory() as memory:
        memory.begin(plan)
    convert(LogChoice.of(memory), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat")
    variables = [str(entry["variable"].item()) for entry in read["signals"][:, 0]]
    assert len(set(variables)) == len(names) + 2
    assert all(name.isidentifier() and name.isascii() and len(name) <= 63 for name in variables)
    assert set(variables) < set(read)


def test_an_array_that_is_too_large_for_mat_names_another_format(recorded, tmp_path, monkeypatch):
    """The format counts its bytes in 32 bits."""
    log, _ = recorded

    def refuse(*_, **__):
        raise MatWriteError("Matrix too large to save with Matlab 5 format")

    monkeypatch.setattr("scipy.io.savemat", refuse)
    with pytest.raises(UsageError, match=r"4 GB .*\(Matrix too large.*use npz"):
        convert(LogChoice.of(log), tmp_path / "a.mat")
    assert not (tmp_path / "a.mat").exists()
