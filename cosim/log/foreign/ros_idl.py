"""Message definitions of ROS 2 in the text of a schema: ``ros2idl``.

::

    ================================================================================
    IDL: demo_msgs/msg/Demo
    #include "std_msgs/msg/Header.idl"
    module demo_msgs { module msg {
      typedef double double__9[9];
      struct Demo {
        std_msgs::msg::Header header;
        double__9 covariance;
        sequence<int16, 4> counts;
      };
    }; };

Modules, structs, typedefs, enumerations and constants are read; annotations, comments and lines
that begin with ``#`` are skipped. An array has one dimension.

OMG, Interface Definition Language 4.2, section 7.4.1; https://design.ros2.org/articles/idl_interface_definition.html
"""

from __future__ import annotations

import re
from typing import Final

from cosim.log.foreign.field_path import FieldProblem
from cosim.log.foreign.ros_definitions import (
    MOST_LEVELS,
    PRIMITIVES,
    STRINGS,
    TIME_FIELDS,
    VARIABLE,
    RosField,
    RosMessages,
    check_messages,
    short_name,
)

_TITLES: Final = re.compile(r"^(?:={3,}|IDL:.*)\s*$", re.MULTILINE)
_TOKEN: Final = re.compile(
    r"""(?P<skipped>\s+|//[^\n]*|/\*.*?\*/|^\#[^\n]*)
    |(?P<word>[A-Za-z_][\w]*(?:::[A-Za-z_]\w*)*)
    |(?P<other>"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|[\d.][\w.+-]*|.)""",
    re.VERBOSE | re.DOTALL | re.MULTILINE,
)
_NUMBERS: Final = {
    "boolean": "bool",
    "octet": "byte",
    "char": "char",
    "short": "int16",
    "unsigned short": "uint16",
    "long": "int32",
    "unsigned long": "uint32",
    "long long": "int64",
    "unsigned long long": "uint64",
    "float": "float32",
    "double": "float64",
}
_WORDS_OF_NUMBERS: Final = ("unsigned", "long", "short", "double")

IdlType = tuple[str, int | None]  # name, and number of elements as of a RosField


def read_ros2idl(name: str, text: str) -> RosMessages:
    """Return the messages that a schema defines, by their names.

    Raises
    ------
    FieldProblem
        If it cannot be parsed.
    """
    reader = _IdlReader(_TITLES.sub("", text))
    reader.definitions()
    messages = {**TIME_FIELDS, **reader.messages}
    check_messages(short_name(name), messages)
    return messages


class _IdlReader:
    """Reads definitions token by token."""

    def __init__(self, text: str) -> None:
        self.messages: dict[str, tuple[RosField, ...]] = {}
        self._types: dict[str, IdlType] = {}  # typedefs and enumerations
        self._tokens: list[str] = []
        for match in _TOKEN.finditer(text):
            if match["skipped"] is None:
                self._tokens.append(match[0])
        self._position = 0
        self._scope: tuple[str, ...] = ()  # the modules around

    # --- tokens ---

    def _peek(self) -> str:
        if self._position == len(self._tokens):
            raise FieldProblem("its schema ends within a definition")
        return self._tokens[self._position]

    def _next(self) -> str:
        token = self._peek()
        self._position += 1
        return token

    def _expect(self, *wanted: str) -> str:
        token = self._next()
        if token not in wanted:
            listed = " or ".join(map(repr, wanted))
            raise FieldProblem(f"its schema: expected {listed}, got {token!r}")
        return token

    def _skip_to(self, *ends: str) -> None:
        """Skip up to and including a token, and all that stands in brackets before it."""
        depth = 0
        while True:
            token = self._next()
            if token in ends and not depth:
                return
            depth += (token in "([{") - (token in ")]}")

    def _skip_annotations(self) -> None:
        while self._position < len(self._tokens) and self._peek() == "@":
            self._position += 2
            if self._peek() == "(":
                self._position += 1
                self._skip_to(")")

    # --- definitions ---

    def definitions(self) -> None:
        """Read definitions up to the end of a module, or of the text."""
        if len(self._scope) > MOST_LEVELS:
            raise FieldProblem(f"its schema nests more than {MOST_LEVELS} modules")
        while True:
            self._skip_annotations()
            if self._position == len(self._tokens) and not self._scope:
                return
            match self._next():
                case "}" if self._scope:
                    return
                case "module":
                    self._scope = (*self._scope, self._next())
                    self._expect("{")
                    self.definitions()
                    self._expect(";")
                    self._scope = self._scope[:-1]
                case "struct":
                    self._struct()
                case "typedef":
                    self._typedef()
                case "enum":
                    self._types[self._full(self._next())] = ("uint32", None)
                    self._skip_to(";")
                case "const":
                    self._skip_to(";")
                case other:
                    raise FieldProblem(
                        "its schema: expected a module, struct, typedef, enum or const, "
                        f"got {other!r}"
                    )

    def _struct(self) -> None:
        name = self._full(self._next())
        self._expect("{")
        fields: list[RosField] = []
        while True:
            self._skip_annotations()
            if self._peek() == "}":
                break
            for field, (type_name, count) in self._declared().items():
                fields.append(RosField(field, type_name, count))
        self._expect("}")
        self._expect(";")
        self.messages[name] = tuple(fields)

    def _typedef(self) -> None:
        for name, declared in self._declared().items():
            self._types[self._full(name)] = declared

    def _declared(self) -> dict[str, IdlType]:
        """Read a type and the names that have it, up to the semicolon."""
        type_name, count = self._type()
        declared = {}
        while True:
            name = self._next()
            own = count
            if self._peek() == "[":
                if count is not None:
                    raise FieldProblem(f"its schema has an array of arrays, {name!r}")
                self._expect("[")
                own = self._number()
                self._expect("]")
            if self._peek() == "[":
                raise FieldProblem(f"its schema has an array of arrays, {name!r}")
            declared[name] = (type_name, own)
            if self._expect(",", ";") == ";":
                return declared

    def _number(self) -> int:
        token = self._next()
        if not re.fullmatch(r"\d{1,9}", token):
            raise FieldProblem(f"its schema: expected a number, got {token!r}")
        return int(token)

    def _type(self) -> IdlType:
        word = self._next()
        if word == "sequence":
            self._expect("<")
            is_nested = self._peek() == "sequence"
            name, count = ("", VARIABLE) if is_nested else self._type()
            if count is not None:
                raise FieldProblem("its schema has a sequence of arrays or sequences")
            if self._expect(",", ">") == ",":
                self._number()
                self._expect(">")
            return name, VARIABLE
        if word in STRINGS:
            if self._peek() == "<":
                self._skip_to(">")
            return word, None
        while word.split()[-1] in _WORDS_OF_NUMBERS and self._peek() in _WORDS_OF_NUMBERS:
            word += f" {self._next()}"
        if word in _NUMBERS:
            return _NUMBERS[word], None
        if word in PRIMITIVES:
            return word, None
        return self._named(word)

    def _named(self, word: str) -> IdlType:
        parts = word.split("::")
        name = short_name("/".join(parts)) if len(parts) > 1 else self._full(word)
        return self._types.get(name, (name, None))

    def _full(self, name: str) -> str:
        """Return the name of what is defined here, as ``package/Name``."""
        return short_name("/".join((*self._scope, name)))
