"""Observations over a mesh of devices, and thousands of cameras.

Run as a program, this file is the process of the mesh: devices are counted before JAX starts.
"""

import os
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]


def drive(cameras, landmarks, seed=0):
    """A drive past landmarks that five or six cameras in a row see each, started a little off."""
    import jax.numpy as jnp
    import numpy as np

    from vojax import SE3
    from vojax.cameras import Pinhole

    rng = np.random.default_rng(seed)
    first = rng.integers(0, cameras - 5, size=landmarks)
    points = np.stack(
        [first + rng.uniform(0, 5, landmarks), rng.uniform(-3, 3, landmarks), rng.uniform(5, 15, landmarks)], axis=1
    )
    frame, seen = (first[:, None] + np.arange(6)).ravel(), np.repeat(np.arange(landmarks), 6)
    keep = rng.random(len(frame)) < 0.95
    frame, seen = frame[keep], seen[keep]
    centres = np.stack([np.arange(cameras), np.zeros(cameras), np.zeros(cameras)], axis=1).astype(float)
    local = points[seen] - centres[frame]
    pixels = 500 * local[:, :2] / local[:, 2:] + 0.5 * rng.normal(size=(len(frame), 2))
    start = -centres
    start[1:-1] += 0.02 * rng.normal(size=(cameras - 2, 3))
    poses = np.concatenate([np.tile([1.0, 0, 0, 0], (cameras, 1)), start], axis=1)
    fixed = np.zeros(cameras, bool)
    fixed[[0, -1]] = True
    return (
        (SE3(jnp.asarray(poses)), points + 0.05 * rng.normal(size=points.shape), pixels, frame, seen),
        Pinhole(fx=500.0, fy=500.0, cx=0.0, cy=0.0),
        fixed,
    )


@pytest.mark.slow
def test_thousands_of_cameras_without_lists_of_pairs(x64):
    import equinox as eqx
    import numpy as np

    from vojax import Result
    from vojax.ba import LMOptions, adjust_bundle, bundle_covariance, bundle_problem

    arguments, camera, fixed = drive(2500, 12_000)
    problem = bundle_problem(*arguments, camera, sigma_px=0.5, fixed_cameras=fixed)
    assert problem.layout.unknowns == 6 * 2498
    assert not problem.layout.has_pairs
    assert problem.layout.pair_slots[0].size == 0
    found = eqx.filter_jit(adjust_bundle)(problem, options=LMOptions(max_steps=40))
    assert found.result == Result.success
    seen = np.unique(arguments[4])
    freedom = 2 * len(arguments[2]) - problem.layout.unknowns - 3 * len(seen)
    assert abs(2 * float(found.cost) / freedom - 1) < 0.03
    with pytest.raises(ValueError, match="no pairs of observations"):
        adjust_bundle(problem, solver="dense")
    with pytest.raises(ValueError, match="covariances need the reduced system"):
        bundle_covariance(problem, found.cam_from_world, found.landmarks, found.camera)


def main():
    import equinox as eqx
    import jax
    import numpy as np
    from jax.sharding import Mesh

    from vojax.ba import LMOptions, adjust_bundle, bundle_problem, shard_bundle

    devices = jax.devices()
    assert len(devices) == 8, devices
    arguments, camera, fixed = drive(20, 203)  # slots are no multiple of eight
    options = LMOptions(max_steps=8, tolerance=0.0)
    mesh = Mesh(np.array(devices), ("observations",))
    problem = bundle_problem(*arguments, camera, fixed_cameras=fixed)
    alone = eqx.filter_jit(adjust_bundle)(problem, options=options)
    sharded = shard_bundle(problem, mesh)
    program = eqx.filter_jit(adjust_bundle).lower(sharded, options=options).compile()
    together = program(sharded, options=options)
    assert alone.iterations == together.iterations == 8
    assert together.trace.cost.dtype == np.float32
    np.testing.assert_allclose(together.trace.cost, alone.trace.cost, rtol=2e-4)
    np.testing.assert_allclose(together.cost, alone.cost, rtol=1e-5)
    np.testing.assert_allclose(together.cam_from_world.wxyz_xyz, alone.cam_from_world.wxyz_xyz, atol=2e-3)
    # An eighth of the slots is on each device.
    share = -(-problem.layout.slots // 8)
    text = program.compiled.as_text()
    assert re.search(rf"f32\[2,6,{share}\]", text), f"no block of a Jacobian of {share} slots"
    print("equal")


@pytest.mark.slow
def test_observations_over_eight_devices():
    environment = {
        **os.environ,
        "XLA_FLAGS": "--xla_force_host_platform_device_count=8",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    process = subprocess.run(
        [sys.executable, str(pathlib.Path(__file__).resolve())],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, timeout=900,
        check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout
    assert process.stdout.rstrip().endswith("equal")


if __name__ == "__main__":
    main()
