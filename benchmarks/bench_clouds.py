"""Clouds: ICP and GICP on 10,000 points against 10,000, and 64 small clouds in one call; float32.

A bumpy surface, seen twice with noise of half a per cent of its size, moved by 4 % and turned by three degrees. Normals
and directions of lines are those of the surface; GICP takes its covariances from 20 neighbours.

python benchmarks/bench_clouds.py
"""

import jax
import jax.numpy as jnp
from _timing import describe_machine, time_jitted

from vojax.lie import SE3
from vojax.solvers import gicp, icp

MOTION = jnp.array([0.02, -0.01, 0.03, 0.03, -0.02, 0.035])


def clouds(key, n):
    """Two samples of one surface, the second moved, with its normals and with directions along it."""
    keys = jax.random.split(key, 4)

    def surface(key, noise_key):
        x, y = jax.random.uniform(key, (2, n), minval=-1.0)
        z = 0.2 * jnp.sin(3.0 * x) * jnp.cos(2.0 * y) + 0.3 * x * x
        by_x = 0.6 * jnp.cos(3.0 * x) * jnp.cos(2.0 * y) + 0.6 * x
        by_y = -0.4 * jnp.sin(3.0 * x) * jnp.sin(2.0 * y)
        noise = 0.005 * jax.random.normal(noise_key, (n, 3))
        one, zero = jnp.ones_like(x), jnp.zeros_like(x)
        parts = ((x, y, z), (-by_x, -by_y, one), (one, zero, by_x))
        points, normals, directions = (jnp.stack(part, axis=1) for part in parts)
        return points + noise, normals, directions

    points0, _, _ = surface(keys[0], keys[1])
    points1, normals, directions = surface(keys[2], keys[3])
    motion = SE3.exp(MOTION)
    turned = (motion.rotation().apply(v) for v in (normals, directions))
    return points0, motion.apply(points1), *turned


def main() -> None:
    print(describe_machine(), "\n")
    print("| | seconds | compile, s | error of the motion |")
    print("|---|---|---|---|")
    data = clouds(jax.random.key(0), 10_000)
    report("icp, point to point", lambda a, b, n, d: icp(a, b, iterations=20), data)
    report("icp, to lines", lambda a, b, n, d: icp(a, b, method="point_to_line", directions1=d, iterations=20), data)
    report("icp, to planes", lambda a, b, n, d: icp(a, b, method="point_to_plane", normals1=n, iterations=20), data)
    report("gicp", lambda a, b, n, d: gicp(a, b, iterations=20), data)
    many = jax.vmap(lambda key: clouds(key, 350))(jax.random.split(jax.random.key(1), 64))
    planes = jax.vmap(lambda a, b, n, d: icp(a, b, method="point_to_plane", normals1=n, iterations=30))
    report("icp to planes, 64 clouds of 350, 30 rounds", planes, many)


def report(name, align, data) -> None:
    timing = time_jitted(align, *data)
    found = jax.jit(align)(*data).frame1_from_frame0
    off = jnp.max(jnp.linalg.norm(jnp.atleast_2d((found @ SE3.exp(MOTION).inverse()).log()), axis=1))
    print(f"| {name} | {timing.median:.3f} | {timing.compile:.1f} | {float(off):.4f} |", flush=True)


if __name__ == "__main__":
    main()
