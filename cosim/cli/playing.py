"""The command play, and the options with which a run is shown to viewers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.options import LogArgument, print_notice
from cosim.errors import UsageError
from cosim.report.printable import printable

if TYPE_CHECKING:
    from cosim.live import LiveServer
    from cosim.log import Log

HostOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address for viewers; default: 127.0.0.1, this machine only.",
    ),
]

PortOption = Annotated[
    int | None,
    typer.Option(metavar="NUMBER", help="Port for viewers; default: 8765. 0: any free port."),
]

AllowHostOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Further host whose pages may connect as viewers, or further name of this machine. "
        "Repeatable; default: programs, pages of this machine, app.foxglove.dev.",
    ),
]

LiveOption = Annotated[
    bool,
    typer.Option(
        "--live",
        help="Stream the run to Foxglove or Lichtblick in addition to the log; with "
        "--realtime at the pace of the wall clock.",
    ),
]

ShowOption = Annotated[
    list[str] | None,
    typer.Option(
        "--show",
        metavar="SIGNAL",
        help="With --live: component, signal or pattern to stream; default: all. Repeatable.",
    ),
]


def play(
    log: LogArgument,
    signals: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SIGNAL]...",
            help="Components, signals or patterns, such as '*.delta'; their whole channels are "
            "played. Default: all.",
        ),
    ] = None,
    speed: Annotated[
        float, typer.Option(metavar="FACTOR", help="Simulated time per wall time.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat until Ctrl-C.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a viewer before playing.")] = False,
    host: HostOption = None,
    port: PortOption = None,
    allow_host: AllowHostOption = None,
    layout: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the plot layout of the log for import by viewers (.json)."
        ),
    ] = None,
) -> None:
    """Play a log in Foxglove or Lichtblick in real time.

    Connect the viewer to the printed address (Foxglove WebSocket). Prints at the end how late the
    playback was.
    """
    from cosim.live.playback import Playback
    from cosim.log import open_log
    from cosim.scenario.recordings.interrupting import interruptible

    source = open_log(log)
    if layout is not None:
        _write_layout(source, layout)
    with interruptible() as check, _server(host, port, allow_host, signals) as server:
        playback = Playback(source, server, speed=speed, check=check)
        typer.echo(f"{server.url}: {printable(str(log))}, {speed:g} x the wall clock")
        try:
            if wait:
                server.wait_for_viewer(check)
            playback.run(loop=loop)
        finally:
            typer.echo(str(playback.lateness))


@contextmanager
def shown_live(
    wanted: bool,
    host: str | None,
    port: int | None,
    allow_host: list[str] | None,
    signals: list[str] | None,
) -> Iterator[LiveServer | None]:
    """Yield the server that shows a run; None: it is not shown.

    Raises
    ------
    UsageError
        If there are options of it without it, or it cannot listen.
    """
    if not wanted:
        given = {"--host": host, "--port": port, "--allow-host": allow_host, "--show": signals}
        for name, value in given.items():
            if value is not None and value != []:
                raise UsageError(f"{name} needs --live")
        yield None
        return
    with _server(host, port, allow_host, signals, notice=print_notice) as server:
        yield server


def _server(
    host: str | None,
    port: int | None,
    allow_host: list[str] | None,
    signals: list[str] | None,
    *,
    notice: Callable[[str], None] | None = None,
) -> LiveServer:
    from cosim.live.server import HOST, PORT, LiveServer

    return LiveServer(
        host=HOST if host is None else host,
        port=PORT if port is None else port,
        signals=signals or (),
        allow_host=allow_host or (),
        notice=notice,
    )


def _write_layout(log: Log, path: Path) -> None:
    """Write the layout of a log to a new file.

    Raises
    ------
    LogError
        If the log has none.
    UsageError
        If there is a file, which may be somebody's own layout.
    """
    from cosim.log.contents.viewer_layout import LAYOUT_FILE

    content = log.attachment(LAYOUT_FILE)
    try:
        with path.open("xb") as file:
            file.write(content)
    except FileExistsError as error:
        raise UsageError(f"--layout {path}: exists; choose another path") from error
