"""Programs over rows as instructions on vectors, which compute once what they have in common.

Each instruction writes a register of its own, some rows of values at a time; ``reductions.c`` runs
them.
"""

from __future__ import annotations

from typing import Final, NamedTuple, final

from cosim.native.numerics.expression import OPERATIONS, ConditionProgram, Program

ROW_OPERATIONS: Final = ("column", "where", "hold")  # behind those of expressions
_CODES: Final = {name: code for code, name in enumerate((*OPERATIONS, *ROW_OPERATIONS))}


class RowInstruction(NamedTuple):
    """An operation on registers; see ``cosim_instruction``.

    Parameters
    ----------
    operation : int
    result, a, b : int
        Registers; ``a`` may be the number of a column, ``b`` of a hold.
    """

    operation: int
    result: int
    a: int
    b: int


@final
class RowInstructions:
    """The instructions of several programs.

    Attributes
    ----------
    instructions : list of RowInstruction
        In their order.
    constants : dict of int to float
        By the register whose values they all are.
    durations_ns : list of int
        How long the conditions of holds have to be true, by the number of the hold.
    n_registers : int
    """

    def __init__(self) -> None:
        self.instructions: list[RowInstruction] = []
        self.constants: dict[int, float] = {}
        self.durations_ns: list[int] = []
        self.n_registers = 0
        self._results: dict[tuple[str, int, int], int] = {}
        self._constants: dict[str, int] = {}
        self._holds: dict[tuple[int, int], int] = {}

    def add(self, values: Program | ConditionProgram, where: ConditionProgram | None = None) -> int:
        """Return the register of the values of a program; of a condition 1 where true, else 0.

        With ``where`` they are NaN where that condition is not true.
        """
        register = self._unrestricted(values)
        if where is None:
            return register
        return self._operation("where", register, self._unrestricted(where))

    def _unrestricted(self, values: Program | ConditionProgram) -> int:
        if isinstance(values, Program):
            return self._program(values)
        is_true = self._program(values.program)
        if not values.duration_ns:
            return is_true
        key = (is_true, values.duration_ns)
        if key not in self._holds:
            self._holds[key] = len(self.durations_ns)
            self.durations_ns.append(values.duration_ns)
        return self._operation("hold", is_true, self._holds[key])

    def _program(self, program: Program) -> int:
        stack: list[int] = []
        constants = program.constants.tolist()
        for code in program.code.tolist():
            if code < 0:
                stack.append(self._operation("column", -1 - code))
            elif code >= len(OPERATIONS):
                stack.append(self._constant(constants[code - len(OPERATIONS)]))
            elif code == _CODES["t"]:
                stack.append(self._operation("t"))
            elif code < _CODES["negate"]:
                right = stack.pop()
                stack.append(self._binary(OPERATIONS[code], stack.pop(), right))
            else:
                stack.append(self._operation(OPERATIONS[code], stack.pop()))
        return stack[0]

    def _binary(self, name: str, left: int, right: int) -> int:
        if name == "power" and self.constants.get(right) == 2.0:
            return self._operation("multiply", left, left)  # as cosim_pow
        return self._operation(name, left, right)

    def _constant(self, value: float) -> int:
        bits = value.hex()  # 0 and -0 are equal
        if bits not in self._constants:
            self._constants[bits] = self._new_register()
            self.constants[self._constants[bits]] = value
        return self._constants[bits]

    def _operation(self, name: str, a: int = 0, b: int = 0) -> int:
        key = (name, a, b)
        if key not in self._results:
            result = self._new_register()
            self._results[key] = result
            self.instructions.append(RowInstruction(_CODES[name], result, a, b))
        return self._results[key]

    def _new_register(self) -> int:
        self.n_registers += 1
        return self.n_registers - 1
