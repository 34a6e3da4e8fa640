"""Throughput against the size of the batch, under the roof that the machine sets.

python benchmarks/study_scaling.py [--largest 262144] [--out docs/images/scaling.png]

P3P and five-point hypotheses, residuals of scoring (1,024 points a hypothesis) and adjustments of windows (6 keyframes
× 60 landmarks) a second, float32, compile time apart, the batch divided over one device a core. The roof is the smaller
of two rates, both measured here in the same way: multiply-adds in registers over the operations of one item, and a
stream through memory over the bytes of one item's input and output. Operations are counted in the traced program; a
division or a root counts as one although it takes longer, loops that end early as long as they ran (windows) or once.
A GPU is measured by the same command.
"""

import argparse
import os
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ.setdefault("NPROC", str(2 * (os.cpu_count() or 1)))  # threads enough for devices that wait for each other

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine, time_calls
from bench_windows import simulate
from jax.sharding import NamedSharding, PartitionSpec

from vojax.ba import LMOptions, Squared, adjust_window
from vojax.cameras import Pinhole
from vojax.cli._bench_solvers import problems
from vojax.robust import AbsolutePoseEstimator, msac_scores

POINTS = 1024
BLUE, INK = "#2a5c8a", "#444444"


class Kernel(NamedTuple):
    """What is timed.

    Attributes:
        title: Of its panel.
        function: Of arrays that are divided along `axis`.
        arguments: Arrays of a batch of the given size.
        axis: The batch's.
        items: Counted per element of the batch.
        largest: Batch beyond which it is not taken.
        trips: Passes through loops that end early.
    """

    title: str
    function: Callable[..., Any]
    arguments: Callable[[int], tuple[Any, ...]]
    axis: int = 0
    items: int = 1
    largest: int = 1 << 30
    trips: float = 1.0


def operations(jaxpr: Any, trips: float) -> float:
    """Floating-point operations of a traced program."""
    total = 0.0
    for equation in jaxpr.eqns:
        inner = [operations(found, trips) for found in map(_program, _values(equation.params)) if found is not None]
        name, out = equation.primitive.name, equation.outvars[0].aval if equation.outvars else None
        if name == "cond":
            total += max(inner)
        elif inner:
            repeats = equation.params["length"] if name == "scan" else trips if name == "while" else 1
            total += repeats * sum(inner)
        elif name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            depth = np.prod([equation.invars[0].aval.shape[axis] for axis in contracted])
            total += 2.0 * depth * out.size
        elif name.startswith("reduce_"):
            total += equation.invars[0].aval.size
        elif name in ("add", "sub", "mul", "div", "sqrt", "rsqrt", "max", "min", "integer_pow", "neg", "select_n"):
            total += out.size if jnp.issubdtype(out.dtype, jnp.floating) else 0.0
    return total


def _values(parameters: dict[str, Any]) -> list[Any]:
    values = []
    for value in parameters.values():
        values.extend(value if isinstance(value, tuple | list) else [value])
    return values


def _program(value: Any) -> Any:
    if isinstance(value, jax.extend.core.ClosedJaxpr):
        return value.jaxpr
    return value if isinstance(value, jax.extend.core.Jaxpr) else None


def kernels() -> list[Kernel]:
    """All four."""
    table = problems(1 << 10)

    def solver(name: str, title: str) -> Kernel:
        drawn = [np.asarray(x, np.float32) for x in table[name].arguments()]

        def arguments(batch: int) -> tuple[Any, ...]:
            return tuple(jnp.asarray(np.resize(x, (batch, *x.shape[1:]))) for x in drawn)

        return Kernel(title, jax.vmap(table[name].solver), arguments)

    keys = jax.random.split(jax.random.key(0), 3)
    camera = Pinhole(fx=800.0, fy=800.0, cx=640.0, cy=480.0)
    points = jax.random.uniform(keys[0], (POINTS, 3), minval=-4.0, maxval=4.0)
    pixels = jax.random.uniform(keys[1], (POINTS, 2), maxval=960.0)
    estimator = AbsolutePoseEstimator(points, pixels, camera.unproject(pixels), camera, limit=9.0, local_steps=1)

    def score(models: Any) -> Any:
        return msac_scores(estimator.squared_error, models, estimator.observations, jnp.ones(POINTS), estimator.limit)

    def models(batch: int) -> tuple[Any, ...]:
        return (jax.random.normal(keys[2], (12, batch)).at[11].add(10.0),)

    data, stereo = simulate(0, 6, 60, 1 << 7, jnp.float32)
    data = (*data[:2], data[2][..., :2], data[3])
    fixed, options = jnp.arange(6) < 2, LMOptions(tolerance=1e-6)

    @jax.vmap
    def adjust(*window: Any) -> Any:
        found = adjust_window(*window, stereo.camera, fixed=fixed, loss=Squared(), options=options)
        return found.cost, found.iterations

    def windows(batch: int) -> tuple[Any, ...]:
        rows = np.arange(batch) % (1 << 7)
        return tuple(jax.tree.map(lambda leaf: leaf[rows], data))

    steps = float(jnp.mean(jax.jit(adjust)(*windows(1 << 7))[1]))
    return [
        solver("p3p", "P3P, problems a second"),
        solver("five_point", "five-point, problems a second"),
        Kernel("scoring, residuals a second", score, models, axis=1, items=POINTS, largest=1 << 16),
        Kernel("windows, adjustments a second", adjust, windows, largest=1 << 12, trips=steps),
    ]


def sharded(function: Callable[..., Any], axis: int, arguments: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """The compiled function over all devices, and its arguments there."""
    mesh = jax.make_mesh((len(jax.devices()),), ("batch",))
    along = PartitionSpec(*[None] * axis, "batch")
    divided = jax.shard_map(function, mesh=mesh, in_specs=along, out_specs=PartitionSpec("batch"), check_vma=False)
    placed = jax.device_put(arguments, NamedSharding(mesh, along))
    compiled = jax.jit(divided)
    jax.block_until_ready(compiled(*placed))
    return compiled, placed


def seconds_a_call(function: Callable[..., Any], axis: int, arguments: tuple[Any, ...]) -> float:
    compiled, placed = sharded(function, axis, arguments)
    return time_calls(lambda: jax.block_until_ready(compiled(*placed)), 1.0)[0]


def machine() -> tuple[float, float]:
    """Operations and bytes a second, float32."""
    steps, chains = 256, 8

    def multiply_add(x: Any) -> Any:
        values = [x + float(k) for k in range(chains)]
        for _ in range(steps):
            values = [0.999 * value + 1e-3 for value in values]
        return sum(values)

    few = jnp.ones(1 << 14)
    rate = 2 * steps * chains * few.size / seconds_a_call(multiply_add, 0, (few,))
    many = jnp.ones(1 << 26)
    return rate, 8 * many.size / seconds_a_call(lambda x: 2 * x, 0, (many,))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--largest", type=int, default=1 << 18)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/images/scaling.png"))
    arguments = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    print(describe_machine(), flush=True)
    rate, stream = machine()
    print(f"{rate / 1e9:.1f} G operations/s, {stream / 1e9:.1f} GB/s over {len(jax.devices())} devices", flush=True)
    print("| | " + "operations | bytes | roof, 1/s | best, 1/s (batch) | of the roof | half of it from a batch of |")
    print("|---|---|---|---|---|---|---|")
    curves = [curve(kernel, rate, stream, arguments.largest) for kernel in kernels()]
    draw(curves, arguments.out)


def curve(kernel: Kernel, rate: float, stream: float, largest: int) -> tuple[str, list[int], np.ndarray, float]:
    sizes = [s for s in (4**k for k in range(1, 16)) if s <= min(largest, kernel.largest)]
    rates = []
    for size in sizes:
        rates.append(size * kernel.items / seconds_a_call(kernel.function, kernel.axis, kernel.arguments(size)))
    probe = kernel.arguments(64)
    program, shapes = jax.make_jaxpr(kernel.function, return_shape=True)(*probe)
    count = operations(program.jaxpr, kernel.trips) / (64 * kernel.items)
    moved = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((probe, shapes))) / (64 * kernel.items)
    roof, best = min(rate / count, stream / moved), int(np.argmax(rates))
    half = sizes[int(np.argmax(np.array(rates) >= rates[best] / 2))]
    print(
        f"| {kernel.title.split(',')[0]} | {count:,.0f} | {moved:,.1f} | {roof:.3g} | {rates[best]:.3g} "
        f"({sizes[best]:,}) | {100 * rates[best] / roof:.0f} % | {half:,} |",
        flush=True,
    )
    return kernel.title, sizes, np.array(rates), roof


def draw(curves: list[tuple[str, list[int], np.ndarray, float]], out: pathlib.Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9, 6.4), layout="constrained")
    for axis, (title, sizes, rates, roof) in zip(axes.flat, curves, strict=True):
        axis.loglog(sizes, rates, "o-", color=BLUE, ms=4)
        axis.axhline(roof, color=INK, ls="--", lw=1)
        axis.annotate("roof", (sizes[0], roof), xytext=(0, 3), textcoords="offset points", color=INK, fontsize=9)
        axis.set(title=title, xlabel="batch", ylim=(None, 2.5 * roof))
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
