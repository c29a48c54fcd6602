"""The programs of stages as the structs that ``stage.c`` works through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import Array, addressof
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.core.signals import Layout
from cosim.core.stages.coupling import Stage, StageProgram
from cosim.core.stages.left_limits import JumpColumns
from cosim.core.stages.member import Member
from cosim.core.stages.torn_inputs import KeptInputs, TornInputs
from cosim.core.stages.wires import Wire
from cosim.native.library import int32, pointer
from cosim.native.stages.stage import (
    KINDS,
    CopyStruct,
    JumpStruct,
    MemberStruct,
    OperationStruct,
    SegmentStruct,
    StageStruct,
    SumStruct,
    TermStruct,
    UnknownsStruct,
    WideCopyStruct,
)
from cosim.native.step import NativeStep

TILE_STEPS: Final = 256  # of a segment before the next one, at most
TILE_BYTES: Final = 2**17  # of the rows of so many steps, which stay in the cache

WIDE: Final = 8  # columns, from which on they are copied at once

NativeSteps: TypeAlias = Mapping[str, NativeStep]  # by component


@final
class StageStructs:
    """The structs of some stages, and the memory behind them.

    Parameters
    ----------
    stages : sequence of Stage
    programs : sequence of StageProgram
        Of each.
    steps : mapping of component name to NativeStep
        The compiled steps that there are.
    layout : Layout

    Attributes
    ----------
    stage : StageStruct
        All else hangs on it.
    unknowns : dict of component name to UnknownsStruct
        Of the loops that iterate, by their first components.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        programs: Sequence[StageProgram],
        steps: NativeSteps,
        layout: Layout,
    ) -> None:
        members: list[Member] = []
        for stage in stages:
            members += stage.members
        optional = _optional(layout)
        structs = (MemberStruct * len(members))()
        addresses: dict[str, int] = {}
        by_name: dict[str, MemberStruct] = {}
        wires = []
        for struct, member in zip(structs, members, strict=True):
            _fill(struct, member, steps.get(member.name))
            struct.optional = pointer(optional) + member.columns.start
            wires.append(_add_wires(struct, member))
            if member.jumps is not None:
                wires.append(_add_jumps(struct, member.jumps))
            addresses[member.name] = addressof(struct)
            by_name[member.name] = struct
        operations = _operations(programs, addresses)
        segments = _segments(stages, programs, operations)
        self.unknowns: dict[str, UnknownsStruct] = {}
        put: list[object] = []
        for stage, program, segment in zip(stages, programs, segments, strict=True):
            if stage.kept is not None:
                put.append(_put(by_name, stage.members, stage.kept))
            if stage.torn is None:
                continue
            unknowns = _unknowns(program, stage.torn)
            segment.unknowns = addressof(unknowns)
            self.unknowns[stage.members[0].name] = unknowns
            put.append(_put(by_name, stage.members, stage.torn))
            put.append(_let_go_back(by_name, stage.members, steps))
        tile = max(1, min(TILE_STEPS, TILE_BYTES // (8 * layout.row_width + 8)))
        self.stage = StageStruct(addressof(segments), len(segments), layout.row_width, tile)
        self._keep = (structs, optional, wires, operations, segments, steps, put)


def _optional(layout: Layout) -> NDArray[np.uint8]:
    """Return which columns of a row may have no value (NaN)."""
    optional: list[bool] = []
    for channel in layout.channels:
        for signal in channel.signals:
            optional += [signal.optional] * signal.size
    return np.array(optional, np.uint8)


def _fill(struct: MemberStruct, member: Member, step: NativeStep | None) -> None:
    if step is not None:
        struct.advance = step.function
        struct.outputs = step.outputs
        struct.self = step.address
        if step.left_outputs is not None:
            struct.has_jumped, struct.left_outputs = step.left_outputs
    struct.takes_latest = member.takes_latest
    struct.u = member.inputs.start
    struct.n_u = member.n_u
    struct.y = member.outputs.start
    struct.n_y = member.outputs.stop - member.outputs.start
    struct.seconds = member.component.native_seconds_address
    struct.overridden = member.overrides.columns_address
    struct.gains = member.overrides.gains_address
    struct.overrides = member.overrides.values_address


def _add_jumps(struct: MemberStruct, jumps: JumpColumns) -> object:
    """Write what of a member jumps to its struct; return the memory of that."""
    sources = [JumpStruct(column, -1) for column in jumps.held.tolist()]
    followed = zip(jumps.followed.tolist(), jumps.limits.tolist(), strict=True)
    sources += [JumpStruct(column, limit) for column, limit in followed]
    own = zip(jumps.own_limits.tolist(), jumps.own.tolist(), strict=True)
    limits = [CopyStruct(to, column) for to, column in own]
    source_array = (JumpStruct * len(sources))(*sources)
    limit_array = (CopyStruct * len(limits))(*limits)
    right = np.zeros(len(sources))
    struct.jumps = addressof(source_array)
    struct.right = pointer(right)
    struct.limits = addressof(limit_array)
    struct.n_jumps = len(sources)
    struct.n_limits = len(limits)
    return source_array, right, limit_array


def _operations(
    programs: Sequence[StageProgram], addresses: Mapping[str, int]
) -> Array[OperationStruct]:
    """Return the programs of stages, one behind the other; ``addresses``: of the members."""
    operations = []
    for program in programs:
        for kind, of in program:
            operations.append(OperationStruct(addresses[of[0].name], KINDS[kind], len(of)))
    return (OperationStruct * len(operations))(*operations)


def _segments(
    stages: Sequence[Stage], programs: Sequence[StageProgram], operations: Array[OperationStruct]
) -> Array[SegmentStruct]:
    """Return where the program of each stage stands among the operations."""
    segments = []
    first = 0
    for stage, program in zip(stages, programs, strict=True):
        address = addressof(operations[first])
        segments.append(SegmentStruct(address, len(program), first, int(not stage.is_loop)))
        first += len(program)
    return (SegmentStruct * len(segments))(*segments)


def _unknowns(program: StageProgram, torn: TornInputs) -> UnknownsStruct:
    """Return what a loop solves for, and where its sweeps are in its program."""
    kinds = [kind for kind, _ in program]
    first = kinds.index("restore")
    behind = first + kinds.count("restore")
    return UnknownsStruct(torn.solver.address, pointer(torn.answer), behind, first)


def _put(
    structs: Mapping[str, MemberStruct], members: Sequence[Member], inputs: TornInputs | KeptInputs
) -> object:
    """Put values to inputs of members of a loop; return the memory of that."""
    keep: list[object] = []
    for member in members:
        struct = structs[member.name]
        columns, values = inputs.inputs_of(member)
        numbers = int32(columns)
        struct.n_torn = len(numbers)
        struct.torn = pointer(numbers)
        struct.tried = pointer(values)
        keep += [numbers, values]
    return keep


def _let_go_back(
    structs: Mapping[str, MemberStruct], members: Sequence[Member], steps: NativeSteps
) -> object:
    """Let members of a loop go back to the start of a step; return the memory of that."""
    keep: list[object] = []
    for member in members:
        step = steps.get(member.name)
        if step is not None:
            rollback = step.rollback()
            if rollback is not None:
                structs[member.name].rollback = addressof(rollback)
                keep.append(rollback)
    return keep


def _add_wires(struct: MemberStruct, member: Member) -> object:
    """Write the wires of a member to its struct; return their memory."""
    copies = []
    wide_copies = []
    sums = []
    terms: list[Array[TermStruct]] = []
    for wire in member.wires:
        sources = wire.source_columns
        if wire.gain is None and wire.conversion.copies:
            if len(sources) < WIDE:
                columns = range(wire.to.start, wire.to.stop)
                copies += [CopyStruct(*pair) for pair in zip(columns, sources, strict=True)]
            else:
                wide_copies.append(WideCopyStruct(wire.to.start, sources[0], len(sources)))
            continue
        for row, to in enumerate(range(wire.to.start, wire.to.stop)):
            own_terms = _terms(wire, row)
            sums.append(_sum(to, wire, own_terms))
            terms.append(own_terms)
    copy_array = (CopyStruct * len(copies))(*copies)
    wide_array = (WideCopyStruct * len(wide_copies))(*wide_copies)
    sum_array = (SumStruct * len(sums))(*sums)
    struct.n_copies = len(copies)
    struct.n_wide = len(wide_copies)
    struct.n_sums = len(sums)
    struct.copies = addressof(copy_array)
    struct.wide_copies = addressof(wide_array)
    struct.sums = addressof(sum_array)
    return copy_array, wide_array, sum_array, terms


def _terms(wire: Wire, row: int) -> Array[TermStruct]:
    """Return what is added up for one element of an input."""
    sources = wire.source_columns
    if wire.gain is None:
        return (TermStruct * 1)(TermStruct(sources[row], 1.0))
    terms = []
    for source, factor in zip(sources, wire.gain[row], strict=True):
        if factor != 0.0:
            terms.append(TermStruct(source, factor))
    return (TermStruct * len(terms))(*terms)


def _sum(to: int, wire: Wire, terms: Array[TermStruct]) -> SumStruct:
    conversion = wire.conversion
    factors = (conversion.factor1, conversion.offset1, conversion.offset2, conversion.factor2)
    converts = int(not conversion.copies)
    plain = int(wire.gain is None)
    return SumStruct(addressof(terms), to, len(terms), plain, converts, wire.offset, *factors)
