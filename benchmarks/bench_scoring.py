"""Residuals per second of hypothesis scoring: 4096 poses against 1024 points, float32.

python benchmarks/bench_scoring.py
"""

import jax
import jax.numpy as jnp
from _timing import describe_machine, time_jitted

from vojax.cameras import Pinhole
from vojax.robust import AbsolutePoseEstimator, msac_scores

POSES, POINTS = 4096, 1024


def main() -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    camera = Pinhole(fx=800.0, fy=800.0, cx=640.0, cy=480.0)
    points = jax.random.uniform(keys[0], (POINTS, 3), minval=-4.0, maxval=4.0)
    pixels = jax.random.uniform(keys[1], (POINTS, 2), maxval=960.0)
    models = jax.random.normal(keys[2], (12, POSES)).at[11].add(10.0)
    weights = jnp.ones(POINTS)
    estimator = AbsolutePoseEstimator(points, pixels, camera.unproject(pixels), camera, limit=9.0, local_steps=1)

    def score(models):
        return msac_scores(estimator.squared_error, models, estimator.observations, weights, estimator.limit)

    timing = time_jitted(score, models)
    print(describe_machine())
    print(
        f"scoring {POSES} × {POINTS}: median {POSES * POINTS / timing.median / 1e9:.2f} G residuals/s, "
        f"best {POSES * POINTS / timing.best / 1e9:.2f}, compile {timing.compile:.1f} s"
    )


if __name__ == "__main__":
    main()
