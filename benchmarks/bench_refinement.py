"""Time per problem of 1,000 six-dof refinements of 100 points each, float32, beside stock optimistix and one C++ core.

python benchmarks/bench_refinement.py
"""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from _timing import describe_machine, time_calls, time_jitted

from vojax.ba import refine_absolute_pose
from vojax.datasets import simulate_absolute_pose
from vojax.lie import SE3

PROBLEMS, POINTS = 1000, 100


def main() -> None:
    keys = jax.random.split(jax.random.key(0), PROBLEMS)
    problems = jax.vmap(lambda key: simulate_absolute_pose(key, POINTS, sigma_px=1.0))(keys)
    camera = simulate_absolute_pose(keys[0], POINTS).camera
    offsets = 0.02 * jax.random.normal(jax.random.key(1), (PROBLEMS, 6))
    starts = SE3.exp(offsets) @ problems.cam_from_world
    arguments = (starts.wxyz_xyz, problems.points_world, problems.pixels)

    def ours(pose, points, pixels):
        refined = refine_absolute_pose(SE3(pose), points, pixels, camera)
        return refined.model.wxyz_xyz, refined.covariance

    def stock(pose, points, pixels):
        def residual(tangent, _):
            return camera.project((SE3.exp(-tangent) @ SE3(pose)).apply(points)) - pixels

        solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
        solution = optx.least_squares(residual, solver, jnp.zeros(6), max_steps=20, throw=False)
        return (SE3.exp(-solution.value) @ SE3(pose)).wxyz_xyz

    print(describe_machine())
    for name, function in (("vojax refine_absolute_pose", ours), ("optimistix stock LM + QR", stock)):
        timing = time_jitted(jax.vmap(function), *arguments)
        print(
            f"{name}: median {timing.median / PROBLEMS * 1e6:.1f} µs/problem, best {timing.best / PROBLEMS * 1e6:.1f}, "
            f"compile {timing.compile:.1f} s"
        )
    try:
        import poselib
    except ImportError:
        return
    pixels, points = np.asarray(problems.pixels[0], np.float64), np.asarray(problems.points_world[0], np.float64)
    pose = poselib.CameraPose()
    pose.q, pose.t = np.asarray(starts.wxyz_xyz[0, :4], np.float64), np.asarray(starts.wxyz_xyz[0, 4:], np.float64)
    intrinsics = [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
    model = {"model": "PINHOLE", "width": 1280, "height": 960, "params": intrinsics}
    median, best = time_calls(lambda: poselib.refine_absolute_pose(pixels, points, pose, model, {}))
    print(f"PoseLib refine_absolute_pose, one call from Python: median {median * 1e6:.1f} µs, best {best * 1e6:.1f}")


if __name__ == "__main__":
    main()
