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

from . import _bench_robust, _bench_solvers
from ._arguments import Bench
from ._report import print_line, write_json

_BATCH = {"solvers": 100_000, "robust": 64}
_COLUMNS = {
    "solvers": (
        "solver",
        "dtype",
        "ns per solve",
        "split over devices",
        "fastest",
        "compile s",
        "PoseLib C++, published",
    ),
    "robust": ("estimator", "outliers", "ms, one problem", "ms each, in a batch", "success", "compile s"),
}


def execute(command: Bench) -> None:
    """Measure, print a table and, where asked, write the numbers."""
    batch = _BATCH[command.what] if command.batch is None else command.batch
    if batch < 1:
        raise ValueError(f"the batch is {batch}; expected at least 1")
    _use_every_core()
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)  # a file has room for whole names
    rows = (_solver_rows if command.what == "solvers" else _robust_rows)(command.only, batch, console)
    print_line(console, f"{command.what}, batch {batch}, {_machine()}")
    table = Table()
    for name in _COLUMNS[command.what]:
        text = name in ("solver", "dtype", "estimator", "outliers")
        table.add_column(name, justify="left" if text else "right", no_wrap=True)
    for row in rows:
        table.add_row(*_cells(row))
    console.print(table)
    if command.json is not None:
        write_json(command.json, _numbers(command.what, batch, rows))
        print_line(console, f"in {command.json}")


def _cells(row: _bench_solvers.Row | _bench_robust.Row) -> tuple[str, ...]:
    if isinstance(row, _bench_robust.Row):
        times = (f"{row.milliseconds:.2f}", f"{row.batched:.2f}")
        return row.name, f"{row.outliers:.0%}", *times, f"{row.success:.0%}", f"{row.compile_seconds:.1f}"
    peer = "" if row.poselib_ns is None else f"{row.poselib_ns:.0f}"
    sharded = "" if row.sharded is None else f"{row.sharded:.0f}"
    return row.name, row.dtype, f"{row.nanoseconds:.0f}", sharded, f"{row.best:.0f}", f"{row.compile_seconds:.1f}", peer


def _solver_rows(only: str | None, batch: int, console: Console) -> list[_bench_solvers.Row]:
    chosen = [
        (name, problem, dtype)
        for name, problem in _bench_solvers.problems(batch).items()
        for dtype in ("float32", "float64")
        if only is None or only in name
    ]
    if not chosen:
        raise ValueError(f"no solver is called {only!r}; leave --only out to see them all")
    return [_bench_solvers.measure(*item) for item in _tracked(chosen, console)]


def _robust_rows(only: str | None, batch: int, console: Console) -> list[_bench_robust.Row]:
    chosen = [
        (name, estimator, share)
        for name, estimator in _bench_robust.estimators().items()
        for share in _bench_robust.SHARES
        if only is None or only in name
    ]
    if not chosen:
        raise ValueError(f"no estimator is called {only!r}; leave --only out to see them all")
    return [
        _bench_robust.measure(name, estimator, share, batch) for name, estimator, share in _tracked(chosen, console)
    ]


def _tracked(items: list[Any], console: Console) -> Any:
    return track(items, "compiling and timing", console=console, disable=not console.is_terminal)


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
