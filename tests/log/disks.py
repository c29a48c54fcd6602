"""Disks that get full."""

from __future__ import annotations

import errno
import io
import os

from cosim.log.live_file import PAGE


class FullDisk(io.FileIO):
    """A sparse file on a disk with room for a number of pages."""

    def __init__(self, path, room):
        super().__init__(path, "x+")
        self.room = room
        self.pages = set()

    def write(self, data):
        page = self.tell() // PAGE
        if page not in self.pages:
            if len(self.pages) == self.room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.pages.add(page)
        left = PAGE - self.tell() % PAGE
        return super().write(memoryview(data)[:left])
