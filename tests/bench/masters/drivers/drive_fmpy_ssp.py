"""FMPy: ``simulate_ssp``, which keeps all connectors as rows."""

import shutil
import time
import zipfile
from pathlib import Path

import protocol
from fmpy.ssp.simulation import simulate_ssp

NAMESPACES = (
    'xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription" '
    'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"'
)


def connector(name, kind):
    """Describe a connector."""
    return f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Real/></ssd:Connector>'


def describe(lags):
    """Return the SystemStructure.ssd."""
    components = []
    connections = []
    for lag in lags:
        connectors = connector("y", "output")
        if lag["source"] is not None:  # it wants a connection to every input
            connectors += connector("u", "input")
        source = f"resources/{Path(lag['fmu']).name}"
        components.append(
            f'<ssd:Component name="{lag["name"]}" type="application/x-fmu-sharedlibrary" '
            f'source="{source}"><ssd:Connectors>{connectors}</ssd:Connectors></ssd:Component>'
        )
        if lag["source"] is not None:
            connections.append(
                f'<ssd:Connection startElement="{lags[lag["source"]]["name"]}" startConnector="y" '
                f'endElement="{lag["name"]}" endConnector="u"/>'
            )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><ssd:SystemStructureDescription {NAMESPACES} '
        'version="1.0" name="lags"><ssd:System name="lags">'
        f"<ssd:Elements>{''.join(components)}</ssd:Elements>"
        f"<ssd:Connections>{''.join(connections)}</ssd:Connections>"
        "</ssd:System></ssd:SystemStructureDescription>"
    )


def main():
    """Run."""
    task = protocol.task()
    if task["method"] != "cs":
        protocol.refuse("it is for co-simulation")
    if task["fmi_version"] != "2":
        protocol.refuse("it is for FMI 1 and 2")
    lags = task["lags"]
    path = Path(task["folder"]) / "lags.ssp"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", describe(lags))
        for fmu in sorted({lag["fmu"] for lag in lags}):
            archive.write(fmu, f"resources/{Path(fmu).name}")
    h = task["step_ns"] / 1e9
    shutil.rmtree = lambda *_: None  # not a part of a step; the folder is removed in the end
    began = time.process_time()
    rows = simulate_ssp(str(path), stop_time=(task["steps"] - 0.5) * h, step_size=h)
    seconds = time.process_time() - began
    samples = []
    for sample in task["samples"]:
        row = rows[sample - 1]  # it has the outputs at the end of the step
        samples.append((sample, [row[f"{lag['name']}.y"] for lag in lags]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
