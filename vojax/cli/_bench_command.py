"""`vojax bench`: measure vojax on this machine."""

import contextlib
import os
import platform
from typing import Any

import jax
from rich.console import Console
from rich.progress import track
from rich.table import Table

from vojax._version import __version__

from ._arguments import Bench
from ._bench_solvers import Row, measure, problems
from ._report import print_line, write_json


def execute(command: Bench) -> None:
    """Measure, print a table and, where asked, write the numbers."""
    if command.batch < 1:
        raise ValueError(f"the batch is {command.batch}; expected at least 1")
    _use_every_core()
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)  # a file has room for whole names
    rows = _solver_rows(command, console)
    print_line(console, f"{command.what}, batch {command.batch}, {_machine()}")
    table = Table()
    for name in (
        "solver",
        "dtype",
        "ns per solve",
        "split over devices",
        "fastest",
        "compile s",
        "PoseLib C++, published",
    ):
        table.add_column(name, justify="left" if name in ("solver", "dtype") else "right", no_wrap=True)
    for row in rows:
        peer = "" if row.poselib_ns is None else f"{row.poselib_ns:.0f}"
        sharded = "" if row.sharded is None else f"{row.sharded:.0f}"
        numbers = (f"{row.nanoseconds:.0f}", sharded, f"{row.best:.0f}", f"{row.compile_seconds:.1f}", peer)
        table.add_row(row.name, row.dtype, *numbers)
    console.print(table)
    if command.json is not None:
        write_json(command.json, _numbers(command, rows))
        print_line(console, f"in {command.json}")


def _solver_rows(command: Bench, console: Console) -> list[Row]:
    chosen = [
        (name, problem, dtype)
        for name, problem in problems(command.batch).items()
        for dtype in ("float32", "float64")
        if command.only is None or command.only in name
    ]
    if not chosen:
        raise ValueError(f"no solver is called {command.only!r}; leave --only out to see them all")
    return [
        measure(*item)
        for item in track(chosen, "compiling and timing", console=console, disable=not console.is_terminal)
    ]


def _use_every_core() -> None:
    """Make each core a device of its own, so that kernels that run on one thread can be measured on all of them."""
    # Too late where something used JAX before.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)


def _machine() -> str:
    device = jax.devices()[0]
    devices = f"{len(jax.devices())} {device.platform} devices"
    return f"jax {jax.__version__}, {devices}, {platform.machine()}, Python {platform.python_version()}"


def _numbers(command: Bench, rows: list[Row]) -> dict[str, Any]:
    versions = {"vojax": __version__, "jax": jax.__version__, "python": platform.python_version()}
    return {
        "what": command.what,
        "batch": command.batch,
        "device": jax.default_backend(),
        "versions": versions,
        "rows": [row._asdict() for row in rows],
    }
