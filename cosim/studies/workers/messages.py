"""What a pool and its workers write to each other: one JSON text a line.

::

    pool -> worker     {"opener": ..., "subject": ..., ...}, then a member a line
    worker -> pool     {"refusal": ..., "exit_code": ..., "has_changed": ...} or {"ready": true},
                       then for each member {"outcome": ..., "seconds": ..., "retires": ...}, or
                       the refusal of one that reads another file than the study began with

Floats keep their bits, also infinite ones and NaN.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, NamedTuple, TypeAlias

from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject

_OF_MEMBER: Final = tuple(field.name for field in fields(StudyMember))
_OF_SUBJECT: Final = tuple(field.name for field in fields(StudySubject))
_OF_OUTCOME: Final = tuple(field.name for field in fields(MemberOutcome))
_encode = json.JSONEncoder(default=dict, separators=(",", ":")).encode  # any mapping as a dict
_decode = json.JSONDecoder().decode


@dataclass(frozen=True, slots=True)
class WorkerOpening:
    """What a worker is given first.

    Parameters
    ----------
    opener : str
        ``module:function``; called with the subject, it returns a MemberRunner.
    subject : StudySubject
    import_paths : list of str
        Where the parent finds modules: those of users stand where its program does.
    most_members : int
        After so many the worker ends.
    """

    opener: str
    subject: StudySubject
    import_paths: list[str]
    most_members: int


class WorkerReady(NamedTuple):
    """A worker has opened its runner."""


class WorkerRefusal(NamedTuple):
    """A worker cannot open its runner, or found another file than the study began with.

    The exit code is that of the error.
    """

    text: str
    exit_code: int
    has_changed: bool = False


class WorkerAnswer(NamedTuple):
    """The outcome of a member, how long it took [s], and whether the worker takes no other."""

    outcome: MemberOutcome
    seconds: float
    retires: bool = False


WorkerReply: TypeAlias = WorkerReady | WorkerRefusal | WorkerAnswer


def encode_opening(opening: WorkerOpening) -> bytes:
    """Return the first line for a worker."""
    values = {
        "opener": opening.opener,
        "subject": {name: getattr(opening.subject, name) for name in _OF_SUBJECT},
        "import_paths": opening.import_paths,
        "most_members": opening.most_members,
    }
    return _line(values)


def decode_opening(line: bytes) -> WorkerOpening:
    """Return what a worker is given first."""
    values = _decode(line.decode())
    subject = StudySubject(**values.pop("subject"))
    return WorkerOpening(subject=subject, **values)


def encode_member(member: StudyMember) -> bytes:
    """Return the line of a member."""
    return _line({name: getattr(member, name) for name in _OF_MEMBER})


def decode_member(line: bytes) -> StudyMember:
    """Return the member of a line."""
    return StudyMember(**_decode(line.decode()))


def encode_reply(reply: WorkerReply) -> bytes:
    """Return the line of a reply.

    Raises
    ------
    TypeError
        If an outcome holds what JSON cannot carry.
    """
    match reply:
        case WorkerReady():
            return _line({"ready": True})
        case WorkerRefusal():
            refusal = {"refusal": reply.text, "exit_code": reply.exit_code}
            return _line({**refusal, "has_changed": reply.has_changed})
    outcome = {name: getattr(reply.outcome, name) for name in _OF_OUTCOME}
    return _line({"outcome": outcome, "seconds": reply.seconds, "retires": reply.retires})


def decode_reply(line: bytes) -> WorkerReply:
    """Return the reply of a line.

    Raises
    ------
    ValueError
        If the line is none: a member wrote into the pipe of its worker.
    """
    try:
        values = _decode(line.decode())
        if "outcome" in values:
            outcome = MemberOutcome(**values["outcome"])
            return WorkerAnswer(outcome, values["seconds"], values["retires"])
        if "refusal" in values:
            return WorkerRefusal(values["refusal"], values["exit_code"], values["has_changed"])
        if "ready" in values:
            return WorkerReady()
    except (KeyError, TypeError) as error:
        raise ValueError(f"no reply: {error}") from error
    raise ValueError("no reply")


def _line(values: Mapping[str, Any]) -> bytes:
    return (_encode(values) + "\n").encode()
