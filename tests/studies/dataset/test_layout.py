"""Which member is in which part."""

from hypothesis import given
from hypothesis import strategies as st

from cosim.studies.dataset import PartLayout, part_members, part_name


@st.composite
def layouts(draw):
    """Return the division of a study that was grown, or cut where nothing was recorded."""
    layout = PartLayout(draw(st.integers(1, 12)), (draw(st.integers(1, 60)),))
    for total in draw(st.lists(st.integers(1, 90), max_size=4)):
        layout = layout.grown(total)
    return layout


@given(layouts())
def test_every_member_is_in_one_part(layout):
    """Parts follow each other from the first member to the last, none is larger than the size."""
    parts = list(layout.parts())
    assert [number for part in parts for number in part] == list(range(layout.total))
    assert all(0 < len(part) <= layout.size for part in parts)
    for part in parts:
        assert {layout.part_of(number) for number in part} == {part}


@given(layouts(), st.integers(0, 50))
def test_parts_stay_where_a_study_grows(layout, more):
    """Those that are complete are parts of the grown study, too."""
    grown = layout.grown(layout.total + more)
    assert list(grown.parts())[: len(list(layout.parts()))] == list(layout.parts())


@given(layouts())
def test_the_names_of_parts_are_in_their_order(layout):
    """And say which members they hold."""
    parts = list(layout.parts())
    names = [part_name(part) for part in parts]
    assert names == sorted(names)
    assert [part_members(name.removeprefix("parts/")) for name in names] == parts


def test_other_names_are_those_of_no_part():
    """Nor that of a part which is being written."""
    for name in ("part-1.parquet", "_part-0-9.parquet.00.tmp", "part-0-9.parquet.tmp", "notes.txt"):
        assert part_members(name) is None
