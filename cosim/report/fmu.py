"""FMUs: what one contains, what a check finds, a linearization."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Any

from cosim.errors import listing
from cosim.report.tables.console import Shown, new_table
from cosim.units import BASE

if TYPE_CHECKING:
    from cosim.fmi.checking.structure import Finding
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.variable import Variable

Row = dict[str, Any]


def describe_fmu(path: str) -> Row:
    """Describe an FMU: capabilities of its interface types, units, variables, dependencies."""
    from cosim.fmi.reading.model_description import read

    archive = read(path)
    description = archive.description
    about = {
        "name": description.name,
        "fmi_version": description.version,
        "tool": description.tool or None,
        "platforms": list(description.platforms),
        "states": list(description.states),
        "n_states": description.n_states,
        "event_indicators": description.event_indicators,
        "clocks": list(description.clocks),
        "default_step": description.default_step,
        "default_tolerance": description.default_tolerance,
        "sha256": archive.sha256,
    }
    ports = [*description.ports("input"), *description.ports("output")]
    bases = {(one.unit, one.base) for one in description.variables if one.unit and one.base}
    return {
        "fmu": about,
        "capabilities": {key: asdict(values) for key, values in description.capabilities.items()},
        # of units with the same name, the one with an offset
        "units": {
            unit: asdict(base)
            for unit, base in sorted(bases, key=lambda pair: (pair[0], abs(pair[1].offset)))
        },
        # ports that are several scalar variables
        "vectors": {signal.name: [v.name for v in group] for signal, group in ports if group[1:]},
        "variables": [_plain_variable(variable) for variable in description.variables],
        "dependencies": description.dependencies,
        "initial_dependencies": description.initial_dependencies,
        "residual_form": description.dae and asdict(description.dae),
    }


def _plain_variable(variable: Variable) -> Row:
    """Return all of a variable; infinite limits are None."""
    # Not by asdict, which copies every value of very many variables deeply.
    row = {field.name: getattr(variable, field.name) for field in fields(variable)}
    row["base"] = variable.base and asdict(variable.base)
    for limit in ("minimum", "maximum"):
        row[limit] = None if math.isinf(row[limit]) else row[limit]
    return row


def fmu_sections(content: Row) -> Iterable[tuple[str, Any]]:
    """Return what :func:`describe_fmu` returns by titles, one line for each variable.

    What an FMU does not have gets no line.
    """
    from cosim.fmi.description import INTERFACE_TYPE_NAMES

    about = {
        _words(key): ", ".join(value) if isinstance(value, list) else value
        for key, value in content["fmu"].items()
        if value not in (None, [], 0)
    }
    capabilities = {}
    for interface_type, values in content["capabilities"].items():
        names = [
            _words(key) if value is True else f"{_words(key)} {value}"
            for key, value in values.items()
            if value
        ]
        capabilities[INTERFACE_TYPE_NAMES[interface_type]] = ", ".join(names)
    variables = content["variables"]
    initial = content["initial_dependencies"]
    in_order = [row["name"] for row in variables if row["name"] in initial]
    sections = {
        "fmu": about,
        "capabilities": capabilities,
        "units in SI": {name: _si(base) for name, base in content["units"].items()},
        "vector signals": {name: listing(parts) for name, parts in content["vectors"].items()},
        "variables": [_variable_row(row, content) for row in variables],
        "initial dependencies": {name: _names(initial[name]) for name in in_order},
        "residual form": dict(_residual_form_rows(content["residual_form"])),
    }
    return sections.items()


def _words(key: str) -> str:
    return key.replace("_", " ")


def _names(names: Sequence[str] | None) -> str:
    return "unknown" if names is None else ", ".join(names) or "nothing"


def _si(base: Row) -> str:
    powers = zip(BASE, base["exponents"], strict=True)
    texts = [name if power == 1 else f"{name}{power}" for name, power in powers if power]
    offset = f" + {base['offset']:g}" if base["offset"] else ""
    return f"{base['factor']!r} {'.'.join(texts) or '1'}{offset}"


def _residual_form_rows(dae: Row | None) -> Iterable[tuple[str, str]]:
    """Yield unknowns, problems, and what the equations and the unknowns depend on."""
    if dae is None:
        return
    if dae["version"]:
        yield "fmi-ls-dae", dae["version"]
    if dae["algebraic"]:
        yield "algebraic variables", ", ".join(dae["algebraic"])
    if dae["problems"]:
        yield "problems", "; ".join(dae["problems"])
    residuals = chain.from_iterable(dae["residuals"])
    on = [(f"0 = {residual['name']}", residual["dependencies"]) for residual in residuals]
    for name, names in (*on, *dae["dependencies"].items()):
        yield name, f"depends on {_names(names)}"


def _variable_row(variable: Row, content: Row) -> Row:
    """Return a variable as a row: of a state that it is one, of an output what it depends on."""
    is_output = variable["causality"] == "output"
    is_state = variable["name"] in content["fmu"]["states"]
    relation = None
    if is_state:
        relation = "state"
    elif variable["alias_of"]:
        relation = f"alias {variable['alias_of']}"
    elif variable["negated"]:
        relation = "negated"
    elif variable["derivative_of"]:
        relation = f"der {variable['derivative_of']}"
    elif variable["type"] in ("String", "Binary", "Clock") and is_output:
        relation = "not recorded"
    depends = (is_output or variable["derivative_of"] is not None) and not variable["alias_of"]
    names = content["dependencies"].get(variable["name"])
    items = [f"{value} {name}" for name, value in variable["items"].items()]
    limits = [
        "" if (one := variable[end]) is None else f"{one:g}" for end in ("minimum", "maximum")
    ]
    return {
        "variable": variable["name"],
        "causality": variable["causality"],
        "variability": variable["variability"],
        "type": variable["type"] + "".join(f"[{length}]" for length in variable["dimensions"]),
        "unit": variable["unit"],
        "start": _start(variable),
        "range": ", ".join(items) or ("..".join(limits) if any(limits) else None),
        "relation": relation,
        "depends on": _names(names) if depends and not is_state else None,
    }


def _start(variable: Row) -> str | None:
    """Return the start values in short: one for all where they are equal, else the first four."""
    values = variable["text"]
    if variable["start"] is not None:
        values = [f"{value:.6g}" for value in variable["start"]]
    if values is None:
        return None
    text = " ".join(values[:4]) + (" ..." if len(values) > 4 else "")
    if len(values) > 1 and len(set(values)) == 1:
        text = f"{len(values)} x {values[0]}"
    return f"approx {text}" if variable["initial"] == "approx" else text


def show_check(path: str, findings: Sequence[Finding]) -> Shown:
    """Show all problems that were found of an FMU."""
    levels = [finding.level for finding in findings]
    numbers = {"error": levels.count("error"), "warning": levels.count("warning")}
    counts = {f"{level}s": number for level, number in numbers.items()}
    yield {"path": path, **counts, "findings": [finding._asdict() for finding in findings]}
    for finding in findings:
        yield f"{finding.level}: {finding.where}: {finding.text}"
    texts = [f"{n} {level}{'s' if n > 1 else ''}" for level, n in numbers.items() if n]
    yield f"{path}: {', '.join(texts) or 'no problems found'}"


def show_cache(*, clear: bool) -> Shown:
    """Show where results of trials and compiled files are kept; remove them where ``clear``."""
    from cosim.fmi import cache

    folder = cache.cache_folder()
    removed = cache.clear() if clear else 0
    n_trials = len(list(cache.cached_files(cache.TRIALS)))
    sizes = [status.st_size for _, status in cache.cached_files()]
    yield {
        "folder": None if folder is None else str(folder),
        "files": len(sizes),
        "bytes": sum(sizes),
        "removed": removed,
    }
    if folder is None:
        yield "no cache: COSIM_CACHE is empty"
    elif clear:
        yield f"{folder}: {removed} removed"
    else:
        counts = f"{n_trials} trial results, {len(sizes) - n_trials} compiled files"
        yield f"{folder}: {counts}, {sum(sizes)} bytes"


def show_linearization(one: Linearization) -> Shown:
    """Show a linearization: operating point, matrices, poles, static gain, origin."""
    from cosim.fmi.linearizing.linearization import pole_text

    gain = one.static_gain
    poles = one.poles.tolist()
    content = one.to_dict()
    content["poles"] = [[pole.real, pole.imag] for pole in poles]
    content["static_gain"] = None if gain is None else gain.tolist()
    yield content
    names = (*one.states, *one.inputs, *one.outputs)
    values = [f"{value:.6g}" for value in (*one.x, *one.u, *one.y)]
    slopes = [f"{slope:.6g}" for slope in one.dx]
    point = zip_longest(names, values, slopes, fillvalue="")
    title = f"{one.name} at t = {one.t:g} s"
    yield new_table(title, ("", "value", "derivative"), point)
    derivatives = [f"der({name})" for name in one.states]
    matrices = [
        ("A", one.A, derivatives, one.states),
        ("B", one.B, derivatives, one.inputs),
        ("C", one.C, one.outputs, one.states),
        ("D", one.D, one.outputs, one.inputs),
    ]
    if gain is not None:
        matrices.append(("static gain D - C A^-1 B", gain, one.outputs, one.inputs))
    for name, matrix, rows, columns in matrices:
        error = one.errors.get(name)
        title = name if error is None else f"{name}, error up to {error:.1g}"
        cells = [[f"{value:.6g}" for value in values] for values in matrix.tolist()]
        lines = [[row, *texts] for row, texts in zip(rows, cells, strict=True)]
        if matrix.size:
            yield new_table(title, ("", *columns), lines)
    about = [("poles", ", ".join(map(pole_text, poles)) or "none")]
    about += [("static gain", "none, as A is singular")] if gain is None else []
    about.append(("method", ", ".join(dict.fromkeys(one.made.values()))))
    about += [("note", note) for note in one.notes]
    yield new_table("", ("", ""), about)
