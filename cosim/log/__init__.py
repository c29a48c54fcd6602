"""Logs: runs recorded to MCAP files, read back bit for bit, and compared."""

from cosim.log.preamble import Attachment
from cosim.log.reader import Log, LogMessage, open_log
from cosim.log.writer import McapRecorder

__all__ = ["Attachment", "Log", "LogMessage", "McapRecorder", "open_log"]
