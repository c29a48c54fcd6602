"""FMUs: what one contains, what a check finds, a linearization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cosim.errors import listing
from cosim.report.tables.console import (
    new_table,
    print_json,
    print_line,
    print_sections,
    print_table,
)
from cosim.units import BASE

if TYPE_CHECKING:
    from cosim.arrays import Matrix
    from cosim.fmi.checking.structure import Finding
    from cosim.fmi.linearizing.linearization import Linearization

Row = dict[str, Any]


def print_fmu(content: Row) -> None:
    """Print what :func:`cosim.report.inspection.describe_fmu` returns, one line for each variable.

    What an FMU does not have gets no line.
    """
    from cosim.fmi.description import INTERFACE_TYPE_NAMES

    about = {}
    for key, value in content["fmu"].items():
        if value not in (None, [], 0):
            about[_words(key)] = ", ".join(value) if isinstance(value, list) else value
    capabilities = {}
    for interface_type, names in content["capabilities"].items():
        capabilities[INTERFACE_TYPE_NAMES[interface_type]] = _capability_names(names)
    vectors = {name: listing(parts) for name, parts in content["vectors"].items()}
    dependencies = content["dependencies"]
    states = content["fmu"]["states"]
    variables = content["variables"]
    initial = _initial_rows(variables, content["initial_dependencies"])
    residual_form = content["residual_form"]
    sections = {
        "fmu": about,
        "capabilities": capabilities,
        "units in SI": {name: _si(base) for name, base in content["units"].items()},
        "vector signals": vectors,
        "variables": [_variable_row(row, states, dependencies) for row in variables],
        "initial dependencies": initial,
        "residual form": _residual_form_rows(residual_form) if residual_form else {},
    }
    print_sections(sections.items())


def _initial_rows(
    variables: Sequence[Row], dependencies: Mapping[str, Sequence[str] | None]
) -> Row:
    """Return what initial unknowns depend on, in the order of the variables."""
    rows = {}
    for variable in variables:
        name = variable["name"]
        if name in dependencies:
            rows[name] = _names(dependencies[name])
    return rows


def _words(key: str) -> str:
    return key.replace("_", " ")


def _names(names: Sequence[str] | None) -> str:
    if names is None:
        return "unknown"
    return ", ".join(names) or "nothing"


def _capability_names(capabilities: Row) -> str:
    names = []
    for key, value in capabilities.items():
        if value is True:
            names.append(_words(key))
        elif value:
            names.append(f"{_words(key)} {value}")
    return ", ".join(names)


def _si(base: Row) -> str:
    powers = []
    for name, power in zip(BASE, base["exponents"], strict=True):
        if power:
            powers.append(name if power == 1 else f"{name}{power}")
    offset = f" + {base['offset']:g}" if base["offset"] else ""
    return f"{base['factor']!r} {'.'.join(powers) or '1'}{offset}"


def _residual_form_rows(dae: Row) -> Row:
    """Return unknowns, problems, and what the equations and the unknowns depend on."""
    rows = {}
    if dae["version"]:
        rows["fmi-ls-dae"] = dae["version"]
    if dae["algebraic"]:
        rows["algebraic variables"] = ", ".join(dae["algebraic"])
    if dae["problems"]:
        rows["problems"] = "; ".join(dae["problems"])
    for equation in dae["residuals"]:
        for residual in equation:
            rows[f"0 = {residual['name']}"] = f"depends on {_names(residual['dependencies'])}"
    for name, names in dae["dependencies"].items():
        rows[name] = f"depends on {_names(names)}"
    return rows


def _variable_row(
    variable: Row, states: Sequence[str], dependencies: Mapping[str, list[str] | None]
) -> Row:
    dimensions = "".join(f"[{dimension}]" for dimension in variable["dimensions"])
    items = [f"{value} {name}" for name, value in variable["items"].items()]
    relation = None
    if variable["alias_of"]:
        relation = f"alias {variable['alias_of']}"
    elif variable["negated"]:
        relation = "negated"
    elif variable["derivative_of"]:
        relation = f"der {variable['derivative_of']}"
    elif variable["type"] in ("String", "Binary", "Clock") and variable["causality"] == "output":
        relation = "not recorded"
    depends_on = None
    if variable["name"] in states:
        relation = "state"
    elif not variable["alias_of"]:
        depends_on = _depends_on(variable, dependencies)
    row = {"variable": variable["name"]}
    row["causality"] = variable["causality"]
    row["variability"] = variable["variability"]
    row["type"] = variable["type"] + dimensions
    row["unit"] = variable["unit"]
    row["start"] = _start(variable)
    row["range"] = ", ".join(items) or _range(variable["minimum"], variable["maximum"])
    row["relation"] = relation
    row["depends on"] = depends_on
    return row


def _range(minimum: float | None, maximum: float | None) -> str | None:
    if minimum is None and maximum is None:
        return None
    low = "" if minimum is None else f"{minimum:g}"
    high = "" if maximum is None else f"{maximum:g}"
    return f"{low}..{high}"


def _start(variable: Row) -> str | None:
    """Return the start values in short: one for all where they are equal, else the first four."""
    values = variable["text"]
    if variable["start"] is not None:
        values = [f"{value:.6g}" for value in variable["start"]]
    if values is None:
        return None
    text = " ".join(values[:4])
    distinct = len(set(values))
    if distinct == 1 and len(values) > 1:
        text = f"{len(values)} x {values[0]}"
    elif len(values) > 4:
        text += " ..."
    return f"approx {text}" if variable["initial"] == "approx" else text


def _depends_on(variable: Row, dependencies: Mapping[str, list[str] | None]) -> str | None:
    if variable["causality"] != "output" and variable["derivative_of"] is None:
        return None
    return _names(dependencies.get(variable["name"]))


def print_check(path: str, findings: Sequence[Finding], *, as_json: bool) -> None:
    """Print all problems that were found of an FMU."""
    levels = [finding.level for finding in findings]
    errors = levels.count("error")
    warnings = levels.count("warning")
    if as_json:
        rows = [finding._asdict() for finding in findings]
        print_json({"path": path, "errors": errors, "warnings": warnings, "findings": rows})
    else:
        for finding in findings:
            print_line(f"{finding.level}: {finding.where}: {finding.text}")
        counts = [*_count(errors, "error"), *_count(warnings, "warning")]
        print_line(f"{path}: {', '.join(counts) or 'no problems found'}")


def _count(number: int, word: str) -> list[str]:
    """Return ``["2 errors"]``; nothing for 0."""
    if not number:
        return []
    return [f"{number} {word}{'s' if number > 1 else ''}"]


def print_cache(*, clear: bool, as_json: bool) -> None:
    """Print where results of trials and compiled files are kept; remove them where ``clear``."""
    from cosim.fmi import cache

    folder = cache.cache_folder()
    removed = cache.clear() if clear else 0
    n_trials = len(list(cache.cached_files(cache.TRIALS)))
    sizes = [status.st_size for _, status in cache.cached_files()]
    content = {
        "folder": None if folder is None else str(folder),
        "files": len(sizes),
        "bytes": sum(sizes),
        "removed": removed,
    }
    if as_json:
        print_json(content)
    elif folder is None:
        print_line("no cache: COSIM_CACHE is empty")
    elif clear:
        print_line(f"{folder}: {removed} removed")
    else:
        n_compiled = len(sizes) - n_trials
        counts = f"{n_trials} trial results, {n_compiled} compiled files"
        print_line(f"{folder}: {counts}, {sum(sizes)} bytes")


def print_linearization(linearization: Linearization, *, as_json: bool) -> None:
    """Print a linearization: operating point, matrices, poles, static gain, origin."""
    from cosim.fmi.linearizing.linearization import pole_text

    gain = linearization.static_gain
    if as_json:
        content = linearization.to_dict()
        content["poles"] = [[pole.real, pole.imag] for pole in linearization.poles.tolist()]
        content["static_gain"] = None if gain is None else gain.tolist()
        print_json(content)
        return
    _print_operating_point(linearization)
    _print_matrices(linearization)
    if gain is not None:
        outputs = linearization.outputs
        _print_matrix("static gain D - C A^-1 B", gain, outputs, linearization.inputs)
    table = new_table("", ("", ""))
    poles = [pole_text(pole) for pole in linearization.poles.tolist()]
    table.add_row("poles", ", ".join(poles) or "none")
    if gain is None:
        table.add_row("static gain", "none, as A is singular")
    methods = dict.fromkeys(linearization.made.values())
    table.add_row("method", ", ".join(methods))
    for note in linearization.notes:
        table.add_row("note", note)
    print_table(table)


def _print_operating_point(linearization: Linearization) -> None:
    title = f"{linearization.name} at t = {linearization.t:g} s"
    table = new_table(title, ("", "value", "derivative"))
    states = zip(linearization.states, linearization.x, linearization.dx, strict=True)
    for name, value, derivative in states:
        table.add_row(name, f"{value:.6g}", f"{derivative:.6g}")
    inputs = zip(linearization.inputs, linearization.u, strict=True)
    outputs = zip(linearization.outputs, linearization.y, strict=True)
    for name, value in (*inputs, *outputs):
        table.add_row(name, f"{value:.6g}", "")
    print_table(table)


def _print_matrices(linearization: Linearization) -> None:
    states = linearization.states
    inputs = linearization.inputs
    outputs = linearization.outputs
    derivatives = tuple(f"der({name})" for name in states)
    _print_matrix("A", linearization.A, derivatives, states, error=linearization.errors["A"])
    _print_matrix("B", linearization.B, derivatives, inputs, error=linearization.errors["B"])
    _print_matrix("C", linearization.C, outputs, states, error=linearization.errors["C"])
    _print_matrix("D", linearization.D, outputs, inputs, error=linearization.errors["D"])


def _print_matrix(
    title: str,
    matrix: Matrix,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    error: float | None = None,
) -> None:
    if not matrix.size:
        return
    if error is not None:
        title = f"{title}, error up to {error:.1g}"
    table = new_table(title, ("", *columns))
    for name, values in zip(rows, matrix.tolist(), strict=True):
        cells = [f"{value:.6g}" for value in values]
        table.add_row(name, *cells)
    print_table(table)
