"""The batch axis over a mesh: virtual devices of one process, and two processes; answers equal those of one device.

Run as a program, this file is a process of the mesh: devices are counted before JAX starts, so each test has its own.
"""

import os
import pathlib
import re
import socket
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
BATCH = 16


def facade(kind):
    """`one(key, *data, mask) -> Estimate`, and a batch of problems for it: same arrays for same kind, anywhere."""
    import jax
    import jax.numpy as jnp

    from vojax.datasets import simulate_absolute_pose, simulate_relative_pose, simulate_rigid
    from vojax.robust import RansacOptions, estimate_absolute_pose, estimate_relative_pose, estimate_rigid

    keys = jax.random.split(jax.random.key(0), BATCH)
    # Hard and easy ones side by side, so that they stop after different numbers of chunks.
    if kind == "absolute":
        options = RansacOptions(chunk_size=64)
        problem = jax.vmap(lambda key: simulate_absolute_pose(key, 60, outlier_fraction=0.5))(keys)
        camera = jax.tree.map(lambda x: x[0], problem.camera)
        data = (problem.points_world, problem.pixels)

        def one(key, points, pixels, mask):
            return estimate_absolute_pose(points, pixels, camera, key=key, options=options, mask=mask)

    elif kind == "relative":
        options = RansacOptions(threshold_px=1.5, chunk_size=64)
        problem = jax.vmap(lambda key: simulate_relative_pose(key, 80, outlier_fraction=0.3))(keys)
        camera = jax.tree.map(lambda x: x[0], problem.camera)
        data = (problem.pixels0, problem.pixels1)

        def one(key, pixels0, pixels1, mask):
            return estimate_relative_pose(pixels0, pixels1, camera, camera, key=key, options=options, mask=mask)

    else:
        options = RansacOptions(threshold=0.05, chunk_size=64)
        problem = jax.vmap(lambda key: simulate_rigid(key, 60, outlier_fraction=0.5))(keys)
        data = (problem.points0, problem.points1)

        def one(key, points0, points1, mask):
            return estimate_rigid(points0, points1, key=key, options=options, mask=mask)

    n = data[0].shape[1]
    # The last problem is empty, and some are padded.
    count = jnp.where(jnp.arange(BATCH) == BATCH - 1, 0, n - (jnp.arange(BATCH) % 3) * 10)
    mask = jnp.arange(n)[None] < count[:, None]
    return jax.vmap(one), (jax.random.split(jax.random.key(1), BATCH), *data, mask)


def compare(kind, devices):
    """Run sharded over `devices` and on one device, and check that the answers are the same."""
    import jax
    import numpy as np
    from jax.experimental import multihost_utils
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    estimate, arguments = facade(kind)
    alone = jax.device_get(jax.jit(estimate)(*arguments))

    sharding = NamedSharding(Mesh(np.array(devices), ("batch",)), PartitionSpec("batch"))

    def spread(x):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(spread(jax.random.key_data(x)))
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    program = jax.jit(estimate).lower(*map(spread, arguments)).compile()
    together = program(*map(spread, arguments))
    for leaf in jax.tree.leaves(together):
        assert leaf.sharding.is_equivalent_to(sharding, leaf.ndim), f"a result has {leaf.sharding}"
        assert leaf.addressable_shards[0].data.shape[0] == BATCH // len(devices)
    together = multihost_utils.process_allgather(together, tiled=True)

    assert np.array_equal(together.inliers, alone.inliers)
    assert np.array_equal(together.num_inliers, alone.num_inliers)
    assert np.array_equal(together.num_hypotheses, alone.num_hypotheses)
    assert np.array_equal(*(np.asarray(jax.tree.leaves(x.result)[0]) for x in (together, alone)))
    for a, b in zip(jax.tree.leaves(together.model), jax.tree.leaves(alone.model), strict=True):
        assert a.dtype == np.float32
        # Of order one, but for the 10 m of an absolute pose.
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    counts = np.unique(alone.num_hypotheses)
    assert len(counts) > 2, counts  # or the loops of all would have stopped together
    # Problems do not talk to each other: what is gathered are scores, for XLA's top_k, which it cannot split.
    gathered = re.findall(r"= (\w+\[[\d,]*\])\S* all-gather\(", program.as_text())
    assert len(gathered) <= 2, gathered
    assert all(shape.count(",") == 1 for shape in gathered), gathered


def main(kind, *process):
    import jax

    if process:
        address, index = process
        jax.distributed.initialize(address, num_processes=2, process_id=int(index), initialization_timeout=60)
        assert jax.process_count() == 2
    devices = jax.devices()
    assert len(devices) == (2 if process else 8), devices
    compare(kind, devices)
    print("equal")


def start(kind, *process, devices):
    environment = {
        **os.environ,
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, str(pathlib.Path(__file__).resolve()), kind, *process]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
    )


def finish(processes, timeout=600):
    outputs = []
    try:
        outputs = [process.communicate(timeout=timeout)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return outputs


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["absolute", "relative", "rigid"])
def test_eight_devices_give_the_answers_of_one(kind):
    process = start(kind, devices=8)
    (output,) = finish([process])
    assert process.returncode == 0, output
    assert output.rstrip().endswith("equal")


@pytest.mark.slow
def test_two_processes_give_the_answers_of_one():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [start("rigid", address, str(index), devices=1) for index in range(2)]
    outputs = finish(processes)
    for reason in ("Multiprocess computations aren't implemented", "collectives are not", "Unknown collectives"):
        if any(reason in output for output in outputs):
            pytest.skip(f"this jaxlib has no collectives between processes on CPU: {reason}")
    for process, output in zip(processes, outputs, strict=True):
        assert process.returncode == 0, output
        assert output.rstrip().endswith("equal")


if __name__ == "__main__":
    main(*sys.argv[1:])
