"""For which machine a shared library was built, from its first bytes: ELF, PE and Mach-O."""

from __future__ import annotations

import struct
from typing import Final

ELF: Final = {3: "x86", 62: "x86_64", 40: "aarch32", 183: "aarch64", 243: "riscv64"}
PE: Final = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"}
MACH: Final = {7: "x86", 0x1000007: "x86_64", 0x100000C: "aarch64"}

ELF_MAGIC: Final = b"\x7fELF"
ELF_LITTLE_ENDIAN: Final = 1  # of byte 5
ELF_SHARED_OBJECT: Final = 3  # of the object file type
PE_MAGIC: Final = b"MZ"
PE_SIGNATURE: Final = b"PE\0\0"
MACH_MAGIC: Final = (b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe")  # 64 and 32 bits
MACH_UNIVERSAL_MAGIC: Final = b"\xca\xfe\xba\xbe"


def built_for(head: bytes) -> tuple[str, str] | None:
    """Return (architecture, system) of a shared library from its first kilobyte; None: it is none.

    The architecture is ``any`` where the file holds a library for each of several.
    """
    if head[:4] == ELF_MAGIC and len(head) >= 20:
        return _elf_machine(head)
    if head[:2] == PE_MAGIC and len(head) >= 64:
        return _pe_machine(head)
    if head[:4] in MACH_MAGIC and len(head) >= 8:
        (machine,) = struct.unpack_from("<I", head, 4)
        return MACH.get(machine, f"machine {machine}"), "darwin"
    if head[:4] == MACH_UNIVERSAL_MAGIC:
        return "any", "darwin"
    return None


def _elf_machine(head: bytes) -> tuple[str, str] | None:
    byte_order = "<" if head[5] == ELF_LITTLE_ENDIAN else ">"
    object_type, machine = struct.unpack_from(f"{byte_order}HH", head, 16)
    if object_type != ELF_SHARED_OBJECT:
        return None
    return ELF.get(machine, f"machine {machine}"), "linux"


def _pe_machine(head: bytes) -> tuple[str, str] | None:
    (start,) = struct.unpack_from("<I", head, 60)
    signature = head[start : start + 4]
    if signature != PE_SIGNATURE or len(head) < start + 6:
        return None
    (machine,) = struct.unpack_from("<H", head, start + 4)
    return PE.get(machine, f"machine {machine}"), "windows"
