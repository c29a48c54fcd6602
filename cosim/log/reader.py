"""A log file as arrays: a component's rows are read when first asked for, chunk by chunk, with every CRC checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, final

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.contracts import Design
from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, nearest
from cosim.log.columns import Rows
from cosim.log.compression import MOST_BYTES
from cosim.log.container import MALFORMED, Container
from cosim.log.content import combine, hashable
from cosim.log.layout import Part, read_part, record_dtype, signals_json
from cosim.log.metadata import decode_design, unseal
from cosim.log.scan import Loose, scan
from cosim.log.schema import Level, decode_log

__all__ = ["Log", "Message", "open_log"]
