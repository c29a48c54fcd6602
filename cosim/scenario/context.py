"""What the kinds of components may know of the scenario while they are built, and what is noted of each one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cosim.blocks.replay import Replay
from cosim.core.clock import whole_steps
from cosim.core.contracts import Component, MessageLevel, Recording
from cosim.errors import CosimError, UsageError, nearest
from cosim.scenario.document import Problem
from cosim.scenario.kinds import Kind
from cosim.scenario.parsing import Parsed
from cosim.scenario.schema import matrix
from cosim.theory.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.options import FmuOptions


class MessageSource(Protocol):
    """An opened FMU, as far as its messages go."""

    def drain(self) -> Sequence[tuple[float | None, MessageLevel, str, str]]:
        """Give what it said since the last call, as (time [s] or None, level, category, text)."""
        ...


class _RestsOnAnother(UsageError):
    """A component cannot be judged because one that it reads is wrong; that one is told."""


class ScenarioBuildContext:
    """See :class:`cosim.scenario.kinds.Site`; builds every component, and keeps note of what each one read."""

    step_ns: int
    stop: float

    def __init__(self, scenario: Parsed, resources: ExitStack, recording: Recording | None) -> None:
        self._scenario, self._resources, self._recording = scenario, resources, recording
        self._current = ""
        self.stop = scenario.file.scenario.stop
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}
        self.fmus: dict[str, MessageSource] = {}
        self._linearized: dict[str, Linearization] = {}
        self.files: set[Path] = set()

    def build_all(
        self, problems: list[Problem]
    ) -> tuple[dict[str, Component], dict[str, int], set[str]]:
        """Build every component that can be built; add what is wrong with the others to ``problems``."""
        components: dict[str, Component] = {}
        periods: dict[str, int] = {}
        for name in self._scenario.file.models:
            try:
                self.model(name)
            except (CosimError, ValueError) as error:
                problems.append((("models", name), str(error)))
        for name, spec in self._scenario.specs.items():
            self._current, self.reads[name] = name, frozenset()
            try:
                component = self._build(name, spec)
                periods[name] = self._period(name, spec)
                components[name] = (
                    component
                    if spec.sample_period is None
                    else spec.with_period(component, periods[name])
                )
            except _RestsOnAnother:
                pass
            except (CosimError, ValueError) as error:
                problems.append((("components", name), str(error)))
        return components, periods, set(self._scenario.file.components) - set(components)

    def _build(self, name: str, spec: Kind) -> Component:
        if self._recording is not None and not spec.computable:
            return Replay(self._recording, name)
        return spec.build(name, self)

    def _period(self, name: str, spec: Kind) -> int:
        return (
            1
            if spec.sample_period is None
            else whole_steps(spec.sample_period, self.step_ns, f"period of {name!r}")
        )

    # --- what a kind may ask for ---

    def model(self, name: str) -> DescriptorSystem:
        """Give a model of [models], and note that it was read."""
        models = self._scenario.file.models
        if name not in models:
            raise UsageError(f"there is no model {name!r} in [models]; {nearest(name, models)}")
        self._read(f"models.{name}")
        table = models[name]
        arrays = {
            letter: matrix(getattr(table, letter), f"models.{name}.{letter}")
            for letter in ("A", "Bu", "Bd", "C")
        }
        return DescriptorSystem(n_a=table.n_a, **arrays)

    def spec(self, name: str) -> Kind:
        """Give the table of another component, and note that it was read."""
        self._read(f"components.{name}")
        if name not in self._scenario.specs:
            raise _RestsOnAnother
        return self._scenario.specs[name]

    def driver(self, to: str) -> str | None:
        """Give the component that drives an input, ``component.input``."""
        return self._scenario.driver(to)

    def file(self, path: str) -> Path:
        """Find a file named in the scenario, and note that it is read."""
        found = self._scenario.document.folder / path
        self.files.add(found.resolve())
        return found

    def recording(self, path: str) -> Recording:
        """Open a log with the scenario's communication step."""
        from cosim.log import open_log

        log = open_log(self.file(path))
        if log.step_ns != self.step_ns:
            raise UsageError(
                f"log {path!r} has steps of {log.step_ns / 1e9} s, the scenario of {self.step_ns / 1e9} s; needed the same"
            )
        return log

    def fmu(
        self,
        name: str,
        path: str,
        options: FmuOptions,
    ) -> Component:
        """Load an FMU; it is freed when the run is over."""
        from cosim.fmi.component import load

        opened = load(
            self.file(path),
            options,
            instance_name=name,
        )
        loaded = self._resources.enter_context(opened)
        metadata = loaded.metadata
        self.attachments[f"{name}/modelDescription.xml"] = metadata.pop("model_description")
        self.note(name, **metadata)
        for text in loaded.notes:
            self.warn(name, text)
        self.fmus[name] = loaded
        return loaded.component

    def linearization(
        self,
        name: str,
        path: str,
        *,
        at: float,
        start: Mapping[str, Any],
        inputs: Sequence[str] | None,
        outputs: Sequence[str],
    ) -> Linearization:
        """Linearize an FMU for a component, or take the recorded result where the same was asked."""
        if name not in self._linearized:
            chosen = {"inputs": None if inputs is None else list(inputs), "outputs": list(outputs)}
            asked = {"fmu": path, "at": at, "start": dict(start), **chosen}
            recorded = self._recorded_metadata(name).get("linearization", {})
            if recorded.get("asked") != asked:
                recorded = {
                    "asked": asked,
                    **self._linearize(path, at=at, start=start, inputs=inputs, outputs=outputs),
                }
            self._take(name, recorded)
        return self._linearized[name]

    def _linearize(self, path: str, **wanted: Any) -> dict[str, Any]:
        from cosim.fmi.linearizing.linearize import linearize
        from cosim.fmi.reading.model_description import read

        file = self.file(path)
        return {"sha256": read(file).sha256, "result": linearize(file, **wanted).to_dict()}

    def _take(self, name: str, linearization: dict[str, Any]) -> None:
        from cosim.fmi.linearizing.linearization import Linearization

        found = self._linearized[name] = Linearization.of(linearization["result"])
        self.note(name, linearization=linearization)
        for text in found.notes:
            self.warn(name, text)

    def _recorded_metadata(self, name: str) -> dict[str, Any]:
        if self._recording is None:
            return {}
        found: dict[str, Any] = json.loads(
            self._recording.metadata.get(f"cosim.component.{name}", {}).get("metadata", "{}")
        )
        return found

    def note(self, name: str, **metadata: Any) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component."""
        self.warnings.append((name, text))

    def _read(self, table: str) -> None:
        self.reads[self._current] |= {table}
