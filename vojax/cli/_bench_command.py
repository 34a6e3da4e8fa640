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

from . import _bench_ba, _bench_robust, _bench_solvers, _bench_vo
from ._arguments import Bench
from ._report import print_line, write_json

_MEASURED = {"solvers": _bench_solvers, "robust": _bench_robust, "ba": _bench_ba, "vo": _bench_vo}
_TEXT = ("solver", "dtype", "estimator", "outliers", "problem", "pipeline")


def execute(command: Bench) -> None:
    """Measure, print a table and, where asked, write the numbers."""
    measured = _MEASURED[command.what]
    batch = measured.BATCH if command.batch is None else command.batch
    if batch < 1:
        raise ValueError(f"the batch is {batch}; expected at least 1")
    _use_every_core()
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)  # a file has room for whole names
    tasks = {name: task for name, task in measured.tasks(batch).items() if command.only is None or command.only in name}
    if not tasks:
        raise ValueError(f"no row of {command.what} is called {command.only!r}; leave --only out to see them all")
    hidden = not console.is_terminal
    rows = [task() for task in track(tasks.values(), "compiling and timing", console=console, disable=hidden)]
    print_line(console, f"{command.what}, batch {batch}, {_machine()}")
    table = Table()
    for name in measured.COLUMNS:
        table.add_column(name, justify="left" if name in _TEXT else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row.cells())
    console.print(table)
    if command.json is not None:
        write_json(command.json, _numbers(command.what, batch, rows))
        print_line(console, f"in {command.json}")


def _use_every_core() -> None:
    """Make each core a device of its own, so that kernels that run on one thread can be measured on all of them."""
    # Too late where something used JAX before.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)


def _machine() -> str:
    device = jax.devices()[0]
    devices = f"{len(jax.devices())} {device.platform} devices"
    return f"jax {jax.__version__}, {devices}, {platform.machine()}, Python {platform.python_version()}"


def _numbers(what: str, batch: int, rows: list[Any]) -> dict[str, Any]:
    versions = {"vojax": __version__, "jax": jax.__version__, "python": platform.python_version()}
    return {
        "what": what,
        "batch": batch,
        "device": jax.default_backend(),
        "versions": versions,
        "rows": [row._asdict() for row in rows],
    }
