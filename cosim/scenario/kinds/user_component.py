"""Components of users: a Python class in the scenario's folder, on sys.path, or installed.

What else the table has are the parameters of the class's constructor, by name and annotation:
:mod:`cosim.scenario.kinds.constructor`. How the class is found:
:mod:`cosim.scenario.kinds.user_code`.

The code of a class runs where its component is built: in a run, a dry run, and whatever needs the
component. It does not run to show a scenario. A log names classes too, and may come from anywhere:
a replay takes their components from the recording, unless its caller allows the code.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, StrictStr

from cosim.core.contracts import Component
from cosim.errors import UsageError
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.kinds.constructor import construct
from cosim.scenario.kinds.installed_kinds import installed_class
from cosim.scenario.kinds.user_code import class_name_parts
from cosim.scenario.kinds.values import StepDependence


def _check_class_name(name: str) -> str:
    try:
        class_name_parts(name)
    except UsageError as error:
        raise ValueError(str(error)) from error
    return name


class UserKind(Kind):
    """A component of a class that its user wrote.

    Its other keys are parameters of the constructor.
    """

    model_config = ConfigDict(extra="allow")
    ports: ClassVar[str] = "those of the class"

    @property
    def step_dependence(self) -> StepDependence:
        return StepDependence(jumps_at_points=False)

    @property
    def computable(self) -> bool:
        """Whether a replay may run the class."""
        return self._is_allowed

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the constructor."""
        return self.model_extra or {}


class PythonKind(UserKind):
    """A component of a Python class in the scenario's folder or on sys.path.

    Every other key is a parameter of its constructor.
    """

    kind: Literal["python"]
    class_: Annotated[StrictStr, AfterValidator(_check_class_name)] = Field(
        alias="class",
        description='"package.module:Class"; all other keys are parameters of its constructor',
    )

    @property
    def code(self) -> str:
        return self.class_

    def build(self, name: str, context: BuildContext) -> Component:
        user_class = context.user_class(name, self.code, self.class_)
        return construct(name, user_class, self.parameters)


class InstalledKind(UserKind):
    """A component of a Python class that an installed package declares.

    Every other key is a parameter of its constructor.
    """

    kind: StrictStr

    @property
    def code(self) -> str:
        return self.kind

    def build(self, name: str, context: BuildContext) -> Component:
        installed = installed_class(self.kind)
        package = installed.distribution
        user_class = context.user_class(name, self.code, installed.class_name, package)
        return construct(name, user_class, self.parameters)
