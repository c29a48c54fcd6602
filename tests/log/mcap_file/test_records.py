"""Records of MCAP."""

from __future__ import annotations

from mcap.reader import FOOTER_SIZE as MCAP_FOOTER_SIZE
from mcap.writer import MCAP0_MAGIC

from cosim.log.mcap_records import FOOTER_SIZE, MAGIC


def test_magic_and_footer_are_those_of_mcap():
    """They stand here, as the modules of mcap that have them load every compressor."""
    assert MAGIC == MCAP0_MAGIC
    assert FOOTER_SIZE == MCAP_FOOTER_SIZE
