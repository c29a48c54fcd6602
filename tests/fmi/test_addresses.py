"""A loaded FMU that compiled code calls by address, against its methods in Python."""

from ctypes import byref, c_void_p

import numpy as np
import pytest

from cosim.errors import RunError
from cosim.native.fmi.fmu import CALL_FAILED, DECLINED
from cosim.native.library import library
from tests.fmi import lag
from tests.fmi.probes import NUMBERS, opened

LARGEST = {"Int8": 127, "UInt8": 255, "Int16": 32767, "UInt16": 65535, "Boolean": 1}
LARGEST |= {"Int32": 2**31 - 1, "UInt32": 2**32 - 1, "Int64": 2**63 - 1024}
LARGEST |= {"UInt64": 2**64 - 2048}
SMALLEST = {"Int8": -128, "Int16": -32768, "Int32": -(2**31), "Int64": -(2**63)}


class Compiled:
    """Variables of an instance, set and read by compiled code."""

    def __init__(self, instance, references):
        self.addresses = instance.addresses()
        self._variables = self.addresses.variables(references)

    def set(self, vector):
        arguments = (self.addresses.fmu, byref(self._variables), vector.ctypes.data)
        return library.cosim_fmu_set_any(*arguments)

    def get(self, vector):
        arguments = (self.addresses.fmu, byref(self._variables), vector.ctypes.data)
        return library.cosim_fmu_get_any(*arguments)


def names_of(version):
    if version == "3":
        return ["u", "behavior", *NUMBERS, *(f"{name}s" for name in NUMBERS), "Float64s"]
    return {"1": ["u", "behavior", "flag"], "2": ["u", "answer", "flag"]}[version]


@pytest.fixture(params=["1", "2", "3"])
def instance(request, slave1, probe2, probe3):
    """Return an instance of a version, and references of variables of all types that it has."""
    path = {"1": slave1, "2": probe2, "3": probe3}[request.param]
    with opened(path, interface_type="cs") as (fmu, instance):
        fmu.component.initialize(0.0, np.zeros(fmu.component.interface.n_u))
        fmu.component.outputs(0.0, np.zeros(fmu.component.interface.n_u))
        yield instance, instance.description.references_of(names_of(request.param))


def test_values_of_every_type_are_set_and_read_as_by_the_methods(instance):
    """To and fro, each type of each version, with the largest and smallest of integers."""
    instance, references = instance
    compiled = Compiled(instance, references)
    vectors = [np.arange(references.size) % 2.0]
    for extremes in (LARGEST, SMALLEST):
        types = [element.variable.type for element in references.elements]
        vectors.append(np.array([float(extremes.get(kind, 0)) for kind in types]))
    for vector in vectors:
        assert compiled.set(vector) == 0
        found = np.zeros(references.size)
        assert compiled.get(found) == 0
        expected = instance.get_float64(references)
        assert expected.tolist() == vector.tolist() == found.tolist()


def test_of_a_selection_the_vector_is_the_whole_one(instance):
    instance, references = instance
    first = references.variables[0].size
    mask = np.ones(references.size, np.bool_)
    mask[first] = False
    some = Compiled(instance, references.select(mask))
    instance.set_float64(references, np.zeros(references.size))
    vector = np.ones(references.size)
    assert some.set(vector) == 0
    assert instance.get_float64(references).tolist() == mask.tolist()
    vector[:] = -1.0
    assert some.get(vector) == 0
    assert vector.tolist() == np.where(mask, 1.0, -1.0).tolist()


def test_no_value_is_set_where_one_does_not_fit_its_type(instance, subtests):
    """Exactly where the method refuses it."""
    instance, references = instance

    for value in [0.5, np.nan, np.inf, -np.inf, 2.0**64, -(2.0**64), 2.0**31]:
        with subtests.test(value=value):
            compiled = Compiled(instance, references)
            zeros = np.zeros(references.size)
            for column, element in enumerate(references.elements):
                if element.variable.type in ("Float64", "Float32"):
                    continue
                instance.set_float64(references, zeros)
                vector = np.ones(references.size)
                vector[column] = value
                status = compiled.set(vector)
                if status:
                    assert status == DECLINED
                    assert instance.get_float64(references).tolist() == zeros.tolist()
                    with pytest.raises(RunError, match="expected numbers of type"):
                        instance.set_float64(references, vector)
                else:
                    instance.set_float64(references, vector)
            instance.set_float64(references, zeros)


def test_an_integer_that_is_no_float_is_declined_when_read(probe3, subtests):
    """2**63 - 1 is rounded to 2**63, which the type does not have."""
    of_type = {"Int64": (2**53 + 1, -(2**53) - 1, 2**63 - 1), "UInt64": (2**53 + 1, 2**64 - 1)}
    for name, value in ((name, value) for name, values in of_type.items() for value in values):
        with (
            subtests.test(name=name, value=value),
            opened(probe3, interface_type="cs") as (_, instance),
        ):
            references = instance.description.references_of([name])
            compiled = Compiled(instance, references)
            raw = np.array([value], name.lower())
            instance._calls.access("Set", references.groups[0], raw)
            assert compiled.get(np.zeros(1)) == DECLINED
            with pytest.raises(RunError, match="cannot be carried exactly"):
                instance.get_float64(references)


@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_a_failed_call_is_named_once(tmp_path, version):
    """The lag refuses to be read after an input was set without a step between."""
    with opened(lag.build(tmp_path, version)) as (fmu, instance):
        fmu.component.initialize(0.0, np.zeros(2))
        fmu.component.outputs(0.0, np.zeros(2))
        outputs = instance.description.references("output")
        compiled = Compiled(instance, outputs)
        instance.set_float64(instance.description.references_of(["u"]), np.zeros(1))
        assert compiled.addresses.failure() is None
        assert compiled.get(np.zeros(3)) == CALL_FAILED
        error = compiled.addresses.failure()
        with pytest.raises(RunError) as expected:
            instance.get_float64(outputs)
        assert str(error) == str(expected.value)
        assert compiled.addresses.failure() is None


def test_compiled_code_sees_that_an_instance_was_freed(tmp_path):
    with opened(lag.build(tmp_path, "2")) as (fmu, instance):
        addresses = instance.addresses()
        pointer = c_void_p.from_address(addresses.fmu)
        assert pointer.value
        fmu.close()
        assert pointer.value is None
