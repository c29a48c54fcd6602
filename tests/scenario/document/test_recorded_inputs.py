"""Recorded inputs take the place of their sources."""

from cosim.blocks.renaming import Renaming
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.scenario.document.swaps import MapEntry, record_inputs

PLANT_U = Port.parse("plant.u")
OBSERVER_U = Port.parse("observer.u")
OBSERVER_Y = Port.parse("observer.y")
WRITTEN = {
    PLANT_U: Connection("u.y"),
    OBSERVER_U: Connection("u.y"),
    OBSERVER_Y: Connection("plant.y"),
}


def entry(port, name, causality):
    """Return the entry of a map of the plant."""
    renaming = Renaming(Port.parse(port), (Port.parse(f"plant.{name}"),), causality)
    return MapEntry(("(map)", port), renaming)


def follow(entries, written):
    """Return what becomes of the map and the connections of a recorded plant."""
    connections = {to: source for to, source in written.items() if to.component != "plant"}
    kept, inputs, problems = record_inputs(entries, connections, written)
    return {"plant": kept}, connections, inputs, problems


def test_a_recorded_input_drives_what_took_its_source():
    """It becomes an output; other entries and connections stay."""
    entries = [entry("plant.u", "force", "input"), entry("plant.y", "level", "output")]
    maps, connections, inputs, problems = follow(entries, WRITTEN)
    assert problems == []
    names = [(str(e.renaming.port), e.renaming.causality) for e in maps["plant"]]
    assert names == [("plant.u", "output"), ("plant.y", "output")]
    assert {to: own.sources for to, own in connections.items()} == {
        OBSERVER_U: (PLANT_U,),
        OBSERVER_Y: (Port.parse("plant.y"),),
    }
    (recorded,) = inputs
    assert (recorded.port, recorded.replaced) == (PLANT_U, (Port.parse("u.y"),))
    assert recorded.followers == (OBSERVER_U,)


def test_a_recorded_input_behind_a_gain_is_a_problem_of_its_entry():
    """Its values are not those of the source; the other entries stay."""
    written = {**WRITTEN, PLANT_U: Connection("u.y", 2.0)}
    entries = [entry("plant.u", "force", "input"), entry("plant.y", "level", "output")]
    maps, connections, inputs, problems = follow(entries, written)
    assert [key for key, _ in problems] == [("(map)", "plant.u")]
    assert [str(e.renaming.port) for e in maps["plant"]] == ["plant.y"]
    assert connections[OBSERVER_U].sources == (Port.parse("u.y"),)
    assert inputs == []
