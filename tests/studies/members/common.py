"""What the members of a study have in common, as it is planned on this machine."""

from contextlib import closing

from cosim.studies.members.designs import encode_designs
from cosim.studies.members.member_builder import MemberBuilder


def common_designs(subject):
    """Return the designs of a subject, as text."""
    with closing(MemberBuilder(subject)) as builder:
        return encode_designs(builder.common.given)
