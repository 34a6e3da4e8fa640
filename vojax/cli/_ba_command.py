"""`vojax ba`: bundle adjustment of a file."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from ._arguments import Ba


def execute(command: Ba) -> None:
    """Read, adjust, write and print."""
    if command.max_steps < 1:
        raise ValueError(f"--max-steps is {command.max_steps}; expected 1 or more")
    import jax
    from rich.console import Console

    from ._report import print_line, write_json
    from ._run_command import warn_without_cache

    warn_without_cache()
    console = Console()
    with jax.enable_x64(command.dtype == "float64"):
        problem, write = _OPEN[command.format](command)
        command.out.mkdir(parents=True, exist_ok=True)
        observations = int((problem.weights > 0).sum())
        c, p = len(problem.cam_from_world.wxyz_xyz), len(problem.landmarks)
        print_line(
            console,
            f"{c} cameras, {p} points, {observations} observations, {problem.layout.unknowns} unknowns in the cameras",
        )
        found, report = _adjust(problem, command, console)
        before, after = _residuals(problem, problem), _residuals(problem, found)
        written = write(found)
    write_json(command.out / "report.json", report)
    from vojax.viz import save_figure
    from vojax.viz._residuals import plot_residuals

    title = f"{command.file.name}: ½Σr² {report['initial_cost']:,.2f} → {report['final_cost']:,.2f}"
    save_figure(plot_residuals(before, after, title=title), command.out / "residuals.png")
    for key in ("initial_cost", "final_cost", "iterations", "behind_camera", "solve_seconds", "compile_seconds"):
        value = report[key]
        print_line(console, f"{key.replace('_', ' ')}: {value if isinstance(value, int) else f'{value:,.3f}'}")
    loose = [
        f"{report[f'unconstrained_{what}']} {what}" for what in ("cameras", "points") if report[f"unconstrained_{what}"]
    ]
    if loose:
        print_line(console, f"not constrained by the observations: {', '.join(loose)} (listed in report.json)")
    print_line(console, report["result"])
    print_line(console, f"in {command.out}: {written}, report.json, residuals.png")


def _open_bal(command: Ba) -> tuple[Any, Callable[[Any], str]]:
    import jax.numpy as jnp
    import numpy as np

    from vojax.ba._bundle_problem import bundle_problem
    from vojax.datasets._bal import BalProblem, read_bal, write_bal
    from vojax.lie import SE3

    bal = read_bal(command.file)
    problem = bundle_problem(
        SE3(jnp.asarray(bal.cam_from_world)), bal.landmarks, bal.pixels, bal.camera_index, bal.landmark_index,
        bal.camera(), free_intrinsics=("focal", "k1", "k2"),
    )  # fmt: skip

    def write(found: Any) -> str:
        camera = found.camera
        refined = BalProblem(
            np.asarray(found.cam_from_world.wxyz_xyz, np.float64),
            np.asarray(found.landmarks, np.float64),
            bal.pixels,
            bal.camera_index,
            bal.landmark_index,
            np.stack([np.asarray(values, np.float64) for values in (camera.focal, camera.k1, camera.k2)], axis=1),
        )
        return write_bal(command.out / "refined.txt", refined).name

    return problem, write


def _open_colmap(command: Ba) -> tuple[Any, Callable[[Any], str]]:
    import jax.numpy as jnp
    import numpy as np

    from vojax.ba._bundle_problem import bundle_problem
    from vojax.datasets._colmap import read_colmap, write_colmap
    from vojax.lie import SE3

    model = read_colmap(command.file)
    bundle = model.bundle()
    problem = bundle_problem(
        SE3(jnp.asarray(bundle.cam_from_world)), bundle.landmarks, bundle.pixels, bundle.camera_index,
        bundle.landmark_index, bundle.camera, camera_group=bundle.camera_group, free_intrinsics=bundle.free_intrinsics,
    )  # fmt: skip

    def write(found: Any) -> str:
        refined = model.updated(np.asarray(found.cam_from_world.wxyz_xyz), np.asarray(found.landmarks), found.camera)
        binary = (command.file / "cameras.bin").is_file()
        return write_colmap(command.out / "refined", refined, binary=binary).name

    return problem, write


_OPEN: dict[str, Callable[[Ba], tuple[Any, Callable[[Any], str]]]] = {"bal": _open_bal, "colmap": _open_colmap}


def _adjust(problem: Any, command: Ba, console: Any) -> tuple[Any, dict[str, Any]]:
    import equinox as eqx
    import jax
    import numpy as np

    from vojax._result import Result
    from vojax.ba import Cauchy, Huber, LMOptions, Squared
    from vojax.ba._bundle import adjust_bundle

    loss = {"squared": Squared(), "huber": Huber(), "cauchy": Cauchy()}[command.loss]
    options = LMOptions(max_steps=command.max_steps)
    with _table(console) as row:
        arguments = {"loss": loss, "options": options, "report": row}
        start = time.perf_counter()
        compiled = eqx.filter_jit(adjust_bundle).lower(problem, **arguments).compile()
        compile_seconds = time.perf_counter() - start
        start = time.perf_counter()
        found = jax.block_until_ready(compiled(problem, **arguments))
        solve_seconds = time.perf_counter() - start
        jax.effects_barrier()
    cameras = np.flatnonzero(np.asarray(found.unconstrained_cameras)).tolist()
    points = np.flatnonzero(np.asarray(found.unconstrained_landmarks)).tolist()
    return found, {
        "initial_cost": float(found.initial_cost),
        "final_cost": float(found.cost),
        "iterations": int(found.iterations),
        "solve_seconds": solve_seconds,
        "compile_seconds": compile_seconds,
        "behind_camera": int(found.behind_camera),
        "result": Result[found.result],
        "dtype": command.dtype,
        "loss": command.loss,
        "solver": "dense" if problem.layout.has_pairs else "iterative",
        "cameras": len(found.cam_from_world.wxyz_xyz),
        "points": len(found.landmarks),
        "observations": int((problem.weights > 0).sum()),
        "duplicates": int(problem.duplicates),
        "unconstrained_cameras": len(cameras),
        "unconstrained_points": len(points),
        "unconstrained_camera_indices": cameras,
        "unconstrained_point_indices": points,
        "versions": {"jax": jax.__version__},
    }


@contextlib.contextmanager
def _table(console: Any) -> Iterator[Callable[..., None]]:
    """A table that grows with the iterations: live on a terminal, line by line elsewhere."""
    from rich.live import Live
    from rich.table import Table

    heads = ("iteration", "cost", "gradient", "damping", "step", "")
    form = lambda k, cost, gradient, damping, step, accepted: (  # noqa: E731
        str(int(k)), f"{float(cost):,.4f}", f"{float(gradient):.2e}", f"{float(damping):.1e}", f"{float(step):.2e}",
        "" if accepted else "rejected",
    )  # fmt: skip
    if not console.is_terminal:
        console.print("".join(f"{head:>14}" for head in heads).rstrip(), highlight=False, markup=False, soft_wrap=True)

        def line(k: Any, *, cost: Any, accepted: Any, gradient_norm: Any, damping: Any, step_norm: Any) -> None:
            cells = form(k, cost, gradient_norm, damping, step_norm, accepted)
            console.print(
                "".join(f"{cell:>14}" for cell in cells).rstrip(), highlight=False, markup=False, soft_wrap=True
            )

        yield line
        return
    table = Table(box=None)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    with Live(table, console=console, refresh_per_second=10, vertical_overflow="visible"):

        def row(k: Any, *, cost: Any, accepted: Any, gradient_norm: Any, damping: Any, step_norm: Any) -> None:
            table.add_row(*form(k, cost, gradient_norm, damping, step_norm, accepted))

        yield row


def _residuals(problem: Any, at: Any) -> Any:
    """Reprojection errors, pixels, of all observations in their order."""
    import jax
    import numpy as np

    from vojax.lie import SE3

    index, seen = problem.camera_index, problem.landmark_index
    own = problem.layout.camera_group[index]
    points = SE3(at.cam_from_world.wxyz_xyz[index]).apply(at.landmarks[seen])
    camera = jax.tree.map(lambda leaf: leaf[own] if leaf.ndim else leaf, at.camera)
    return np.asarray(camera.project(points) - problem.measurements, np.float64)
