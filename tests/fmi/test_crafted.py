"""Whatever a description says, reading and checking end with a result or a CosimError.

Attributes get values of every wrong kind, elements are moved, nested, repeated and renamed.
"""

import copy
from contextlib import suppress
from random import Random
from xml.etree.ElementTree import Element, fromstring, tostring

import pytest

from cosim.errors import CosimError
from cosim.fmi.checking.check import check
from cosim.report.fmu import describe_fmu, fmu_sections
from cosim.report.tables.console import print_tables, section_tables
from tests.fmi.archives import Entry, write
from tests.fmi.descriptions import CO_SIMULATION, FMI2, FMI3, fmi1

VALUES = (
    "",
    " ",
    "a" * 5000,
    "9" * 5000,
    "-" + "9" * 400,
    "1e99999",
    "-INF",
    "NaN",
    "0x10",
    "٣",
    "true",
    "../../x",
    "\u202e\x85",
    "1 " * 3000,
    "-1",
    "4294967296",
    "[0]",
    "x[" + "9" * 5000 + "]",
    "x[" + "[0]" * 500,
)
DOCUMENTS = (fmi1(), fmi1(CO_SIMULATION.replace("{what}", "Tool")), FMI2, FMI3)


def mutated(random: Random) -> Element:
    """Change a description in up to four places."""
    root = fromstring(random.choice(DOCUMENTS))
    for _ in range(random.randint(1, 4)):
        elements = list(root.iter())
        element = random.choice(elements)
        other = random.choice(elements)
        match random.randrange(6):
            case 0 if element.attrib:
                element.set(random.choice(list(element.attrib)), random.choice(VALUES))
            case 1:
                names = [name for part in elements for name in part.attrib]
                element.set(random.choice(names), random.choice(VALUES))
            case 2:
                element.tag = other.tag
            case 3:
                element.append(copy.deepcopy(other) if other is not root else Element("x"))
            case 4:
                element.extend([Element(other.tag, other.attrib) for _ in range(50)])
            case _:
                for child in list(element):
                    element.remove(child)
    return root


@pytest.mark.parametrize("count", [60, pytest.param(20_000, marks=pytest.mark.campaign)])
def test_crafted_descriptions(tmp_path, monkeypatch, count, capsys):
    """Info shows it or raises a CosimError; the check has findings."""
    monkeypatch.setattr("cosim.fmi.checking.check._run_trials", lambda *_: [])
    random = Random(count)
    for _ in range(count):
        xml = tostring(mutated(random))
        path = write(tmp_path / "x.fmu", [Entry("binaries/linux64/two.so", b"x")], xml=xml)
        with suppress(CosimError):
            print_tables(section_tables(fmu_sections(describe_fmu(str(path)))))
        assert check(path)
        capsys.readouterr()


def deep(element: str, depth: int) -> bytes:
    """Return a description with one element in another, again and again."""
    nested = f"<{element}>" * depth + f"</{element}>" * depth
    return FMI2.replace("</ModelVariables>", f"</ModelVariables>{nested}").encode()


@pytest.mark.parametrize("depth", [60, 100, 100_000])
def test_deep_elements(tmp_path, depth):
    """Up to 64 are read, more refused, without a deep recursion."""
    path = write(tmp_path / "x.fmu", [], xml=deep("a", depth))
    findings = [finding.text for finding in check(path)]
    refused = [text for text in findings if "deep in each other" in text]
    assert bool(refused) == (depth > 64)
