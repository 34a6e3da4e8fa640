"""`vojax compare`: several pipelines on one sequence, one table."""

import pathlib
from collections.abc import Sequence
from typing import Any

from ._arguments import WINDOW, Compare
from ._run_command import warn_without_cache

# Key of metrics.json, heading, format.
_COLUMNS = (
    ("alignment", "alignment", "{}"),
    ("ate_rmse_m", "ATE [m]", "{:.4f}"),
    ("drift_percent", "drift [%]", "{:.3f}"),
    ("kitti_t_rel_percent", "t_rel [%]", "{:.3f}"),
    ("kitti_r_rel_deg_per_100m", "r_rel [°/100 m]", "{:.3f}"),
    ("frames_per_second", "frames/s", "{:.1f}"),
    ("failures", "failures", "{:d}"),
    ("mean_inliers", "inliers", "{:.0f}"),
)


def execute(command: Compare) -> None:
    """Run the pipelines one after the other; one that fails is a row with its error."""
    warn_without_cache()
    from rich.console import Console

    from ._open_sequence import find_pipeline
    from ._report import print_line, write_json
    from ._run import prepare_folder

    if not command.pipelines or len(set(command.pipelines)) < len(command.pipelines):
        found = " ".join(command.pipelines) or "nothing"
        raise ValueError(f"--pipelines: found {found}, expected one name or more, each once")
    for name in command.pipelines:
        find_pipeline(name)
    prepare_folder(command.out)
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)  # a file has room for whole columns
    rows = [_run_one(command, name, console) for name in command.pipelines]
    done = [row for row in rows if "frames" in row]
    if not done:
        errors = "; ".join(f"{row['pipeline']}: {row['error']}" for row in rows)
        raise ValueError(f"no pipeline ran to its end ({errors})")
    title = f"{done[0]['sequence']}, {max(row['frames'] for row in done)} frames"
    _print_table(rows, title, console)
    write_json(command.out / "compare.json", {"sequence": done[0]["sequence"], "pipelines": rows})
    (command.out / "compare.md").write_text(_markdown(rows, title), encoding="utf-8")
    _draw(command, [row["pipeline"] for row in done], title)
    print_line(console, f"in {command.out}: compare.json, compare.md, compare.png, and a folder for each pipeline")


def _run_one(command: Compare, name: str, console: Any) -> dict[str, Any]:
    """The metrics of a pipeline, or its name and error."""
    from ._run import run_sequence

    try:
        return run_sequence(
            _open(command, name),
            command.out / name,
            pipeline=name,
            window=WINDOW[command.window],
            features=command.features,
            seed=command.seed,
            max_frames=command.max_frames,
            console=console,
        )
    except Exception as error:  # whatever befalls one pipeline, the others have their turn
        return {"pipeline": name, "error": " ".join(str(error).split()) or type(error).__name__}


def _open(command: Compare, name: str) -> Any:
    from ._open_sequence import open_source

    return open_source(
        command.dataset,
        command.path,
        name,
        sequence=command.sequence,
        calibration=command.calibration,
        camera_name=command.camera_name,
    )


def _cells(row: dict[str, Any]) -> list[str]:
    values = ((row.get(key), form) for key, _, form in _COLUMNS)
    return [row["pipeline"], *("" if value is None else form.format(value) for value, form in values)]


def _headings() -> list[str]:
    return ["pipeline", *(heading for _, heading, _ in _COLUMNS)]


def _print_table(rows: Sequence[dict[str, Any]], title: str, console: Any) -> None:
    from rich.table import Table

    from ._report import print_line

    table = Table()
    for i, heading in enumerate(_headings()):
        table.add_column(heading, justify="left" if i < 2 else "right", no_wrap=i == 0)
    for row in rows:
        table.add_row(*_cells(row))
    console.print(title, style="bold", highlight=False, markup=False, soft_wrap=True)
    console.print(table)
    for row in rows:
        if row["error"] is not None:
            print_line(console, f"{row['pipeline']}: {row['error']}")


def _markdown(rows: Sequence[dict[str, Any]], title: str) -> str:
    headings = _headings()
    lines = [f"# {title}", "", f"| {' | '.join(headings)} |", f"|---|---|{'---:|' * (len(headings) - 2)}"]
    lines += [f"| {' | '.join(_cells(row))} |" for row in rows]
    remarks = [f"- {row['pipeline']}: {row['error']}" for row in rows if row["error"] is not None]
    return "\n".join([*lines, *(["", *remarks] if remarks else [])]) + "\n"


def _draw(command: Compare, names: Sequence[str], title: str) -> None:
    """All paths in one picture: in the frame of the truth, or without one of the first path with a scale."""
    from vojax.metrics import align, read_trajectory
    from vojax.odometry import PIPELINES
    from vojax.viz import plot_trajectories, save_figure

    from ._run import true_trajectory

    paths = {name: read_trajectory(pathlib.Path(command.out, name, "trajectory.txt")) for name in names}
    longest = max(map(len, paths.values()))
    truth = true_trajectory(_open(command, names[0]).sequence, longest)
    scaled = [name for name in names if PIPELINES[name].scale]
    reference = truth if truth is not None else paths[scaled[0] if scaled else names[0]]
    drawn = {}
    for name, path in paths.items():
        drawn[name] = align(path, reference, "none" if PIPELINES[name].scale else "sim3").estimate
    shown = None if truth is None else truth.from_origin()
    save_figure(plot_trajectories(drawn, shown, title=title), command.out / "compare.png")
