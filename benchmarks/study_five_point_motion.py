"""Relative pose by the five-point algorithm under three patterns of motion.

Claims of Aufderheide, Krybus & Edwards 2012, table 1: of 100 runs with noise of 0.5, 1 and 2 px those with less than
10° of error in the direction of translation and 2° in rotation are 85, 79, 56 for sideways motion, 47, 29, 20 for
motion mainly sideways and up, 21, 9, 4 for random motion; two five-point algorithms give the same numbers.

A run has 50 right correspondences. It draws one sample of five, or ten; the solution with the smallest mean Sampson
error over all 50 counts, and of its four motions the one with most points in front. The source says nothing of its
camera, depths, baselines and rotations. Ours: 640 x 480 pixels, f = 600 px, depths of 4 to 20 baselines, a turn of up
to 5° about any axis, points that both images see. `--grid` varies these. Rotations are judged by the mean angle of the
three axes, as the source has it.

python benchmarks/study_five_point_motion.py [--trials N] [--grid]
"""

import argparse
import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax.geometry import (
    algebraic_error,
    essential_from_pose,
    pose_from_essential,
    sampson_error,
    symmetric_epipolar_error,
)
from vojax.lie import SE3, SO3
from vojax.metrics import axis_rotation_error_deg, translation_direction_error_deg
from vojax.solvers import five_point, five_point_action_matrix

PATTERNS = ("sideways", "mainly sideways, up", "random")
SIGMAS = (0.5, 1.0, 2.0)
SELECTIONS = ("algebraic", "Sampson", "symmetric")
GATE_T, GATE_R = 10.0, 2.0  # degrees
POINTS, DRAWS, CHUNK = 50, 6, 500
HALF_IMAGE = np.array([320.0, 240.0])


class Setting(NamedTuple):
    """What the source leaves open: pixels, mean baselines, radians."""

    focal: float = 600.0
    near: float = 4.0
    far: float = 20.0
    turn: float = np.radians(5.0)
    shortest: float = 1.0  # of the translations, which are uniform from here to 1


def direction(key, pattern):
    """Unit translation of cam1_from_cam0; the pattern is an index, so that one compilation serves all."""
    anywhere = jax.random.normal(key, (3,))
    sideways, up, forward = jax.random.uniform(jax.random.fold_in(key, 1), (3,), minval=-1.0)
    side = jnp.sign(sideways)
    # A camera that rises moves points downwards, along +y.
    mainly = jnp.stack([side, 0.5 * (1.0 + up), 0.3 * forward])
    drawn = jnp.stack([jnp.stack([side, 0.0 * up, 0.0 * up]), mainly, anywhere])[pattern]
    return drawn / jnp.linalg.norm(drawn)


def scene(key, pattern, setting, points):
    """Points in the frame of view 0 that both images see, and the motion."""
    keys = jax.random.split(key, 6)
    half = jnp.asarray(HALF_IMAGE) / setting.focal
    plane = half[None, None] * jax.random.uniform(keys[0], (points, DRAWS, 2), minval=-1.0)
    depth = setting.near + (setting.far - setting.near) * jax.random.uniform(keys[1], (points, DRAWS, 1))
    axis = jax.random.normal(keys[2], (3,))
    rotation = SO3.exp(setting.turn * jax.random.uniform(keys[3]) * axis / jnp.linalg.norm(axis))
    length = setting.shortest + (1.0 - setting.shortest) * jax.random.uniform(keys[5])
    motion = SE3.from_rotation_and_translation(rotation, length * direction(keys[4], pattern))
    drawn = jnp.concatenate([plane, jnp.ones((points, DRAWS, 1))], axis=2) * depth
    moved = motion.apply(drawn)
    seen = (moved[..., 2] > 0.1) & jnp.all(jnp.abs(moved[..., :2]) <= half[None, None] * moved[..., 2:], axis=2)
    # Of a few draws for each point the first that view 1 sees too.
    first = jnp.argmax(seen, axis=1)[:, None, None]
    return jnp.take_along_axis(drawn, first, axis=1)[:, 0], motion


def measure(key, points, sigma, setting):
    """Noisy points on the plane z = 1 of one view."""
    return points[:, :2] / points[:, 2:] + sigma / setting.focal * jax.random.normal(key, (len(points), 2))


def draw(key, pattern, sigma, setting, points=POINTS):
    """What both views measure, and the motion."""
    keys = jax.random.split(key, 3)
    points_cam0, motion = scene(keys[0], pattern, setting, points)
    plane0 = measure(keys[1], points_cam0, sigma, setting)
    return plane0, measure(keys[2], motion.apply(points_cam0), sigma, setting), motion


def homogeneous(plane):
    return jnp.concatenate([plane, jnp.ones_like(plane[:, :1])], axis=1)


def rays_of(plane):
    rays = homogeneous(plane)
    return rays / jnp.linalg.norm(rays, axis=1, keepdims=True)


def judged(selection, essential, plane0, plane1, weights):
    """Weighted sum of the errors of one essential matrix over the correspondences."""
    if selection == "algebraic":
        return jnp.sum(weights * algebraic_error(essential, homogeneous(plane0), homogeneous(plane1)) ** 2)
    error = sampson_error if selection == "Sampson" else symmetric_epipolar_error
    return jnp.sum(weights * error(essential, plane0, plane1))


def pose_errors(pose, motion):
    """Of translation, of rotation as the mean angle of the axes; degrees."""
    turn = axis_rotation_error_deg(pose.rotation(), motion.rotation())
    return jnp.stack([translation_direction_error_deg(pose.translation(), motion.translation()), turn])


def propose(plane0, plane1, samples, solver=five_point):
    """Solutions of the first samples: correspondences are in random order already."""
    rays = [rays_of(plane)[: 5 * samples].reshape(samples, 5, 3) for plane in (plane0, plane1)]
    found = jax.vmap(solver)(*rays)
    return found.models.reshape(-1, 3, 3), found.valid.reshape(-1)


def selected(selection, models, valid, plane0, plane1, weights=1.0):
    error = jax.vmap(lambda e: judged(selection, e, plane0, plane1, weights))(models)
    return jnp.argmin(jnp.where(valid, error, jnp.inf))


def trial(key, pattern, sigma, setting, samples):
    """Errors of the selected motion, degrees; 180 where no sample has a solution."""
    plane0, plane1, motion = draw(key, pattern, sigma, setting)
    models, valid = propose(plane0, plane1, samples)
    best = selected("Sampson", models, valid, plane0, plane1)
    pose, _ = pose_from_essential(models[best], rays_of(plane0), rays_of(plane1))
    return jnp.where(valid.any(), pose_errors(pose, motion), 180.0)


def difference_of_solvers(key, pattern, sigma, setting):
    """Largest entry of the difference between the essential matrices that two solvers select; errors of each."""
    plane0, plane1, motion = draw(key, pattern, sigma, setting)
    chosen, errors = [], []
    for solver in (five_point, five_point_action_matrix):
        models, valid = propose(plane0, plane1, 1, solver)
        chosen.append(models[selected("Sampson", models, valid, plane0, plane1)])
        pose, _ = pose_from_essential(chosen[-1], rays_of(plane0), rays_of(plane1))
        errors.append(pose_errors(pose, motion))
    # Rounding decides the sign where the largest entry is not unique.
    gap = jnp.minimum(*(jnp.max(jnp.abs(chosen[0] - sign * chosen[1])) for sign in (1.0, -1.0)))
    return gap, jnp.stack(errors)


def selections(key, pattern, sigma, setting, judges):
    """Which error selects the solution nearest to the truth, judged on the first `judges` correspondences."""
    plane0, plane1, motion = draw(key, pattern, sigma, setting)
    models, valid = propose(plane0, plane1, 1)
    true = essential_from_pose(motion)
    # Both have norm one: the closer the inner product to ±1, the nearer.
    closeness = jnp.abs(jnp.sum(models * (true / jnp.linalg.norm(true))[None], axis=(1, 2)))
    best = jnp.argmax(jnp.where(valid, closeness, -1.0))
    weights = 1.0 * (jnp.arange(POINTS) < judges)
    picks = jnp.stack([selected(s, models, valid, plane0, plane1, weights) for s in SELECTIONS] + [best])
    poses = [pose_from_essential(models[pick], rays_of(plane0), rays_of(plane1))[0] for pick in picks]
    return picks == best, jnp.stack([pose_errors(pose, motion) for pose in poses]), jnp.sum(valid)


@functools.partial(jax.jit, static_argnums=(0, 3))
def solve(function, keys, arguments, options):
    return jax.vmap(lambda key: function(key, *arguments, *options))(keys)


def run(trials, function, *arguments, options=(), seed=0):
    """`function(key, *arguments, *options)` on that many keys, rounded up to whole chunks; options are static."""
    keys = jax.random.split(jax.random.key(seed), -(-trials // CHUNK) * CHUNK).reshape(-1, CHUNK)
    parts = [jax.tree.map(np.asarray, solve(function, chunk, arguments, options)) for chunk in keys]
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def in_gate(errors):
    return (errors[..., 0] < GATE_T) & (errors[..., 1] < GATE_R)


def share_interval(hits):
    """Share and its 95 % interval (Wilson), per cent."""
    z, n, p = 1.96, len(hits), np.mean(hits)
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + (z / (2 * n)) ** 2)
    return 100 * np.array([p, (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)])


def header(columns):
    return "| | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|"


def table(counts, samples, setting):
    """Counts per 100 of the first runs and of all, mean errors of all runs and of the counted ones."""
    rows = {count: [] for count in counts}
    for i in range(len(PATTERNS)):
        cells = {count: [] for count in counts}
        for sigma in SIGMAS:
            every = run(max(counts), trial, i, sigma, setting, options=(samples,))
            for count in counts:
                errors = every[:count]
                counted = in_gate(errors)
                share, low, high = share_interval(counted)
                means = [errors.mean(axis=0), errors[counted].mean(axis=0) if counted.any() else np.full(2, np.nan)]
                of_all, of_counted = (f"{turn:.2f}°, {shift:.2f}°" for shift, turn in means)
                cells[count].append(f"**{share:.1f}** ({low:.1f}–{high:.1f}); {of_all}; {of_counted}")
        for count in counts:
            rows[count].append(cells[count])
    for count in counts:
        print(f"\n{count} runs, samples: {samples}. Counted per 100 (95 %); mean e_r and e_t of all; of the counted\n")
        print(header([f"{sigma} px" for sigma in SIGMAS]))
        for pattern, cells in zip(PATTERNS, rows[count], strict=True):
            print(f"| {pattern} | " + " | ".join(cells) + " |", flush=True)


VARIANTS = {  # of random motion, as (turn, shortest translation): the others keep 5° and 1
    "turns alike": (np.radians(5.0), 1.0),
    "random turns up to 40°": (np.radians(40.0), 1.0),
    "random lengths 0 to 1": (np.radians(5.0), 0.0),
    "both": (np.radians(40.0), 0.0),
}
DEPTHS = ((1.5, 4.5), (4.0, 6.0), (4.0, 20.0), (16.0, 24.0), (16.0, 80.0))
FOCALS = (300.0, 600.0, 1200.0)


def ordering(trials, samples):
    """Where the ordering of the source holds at all three noises, and where it decays with the noise."""
    print(header(["sideways > mainly sideways", *(f"both > random: {name}" for name in VARIANTS), "all decay"]))
    totals = np.zeros(2 + len(VARIANTS), int)
    for focal in FOCALS:
        for near, far in DEPTHS:
            setting = Setting(focal, near, far)
            hits = [[shares(trials, i, s, setting, samples) for s in SIGMAS] for i in range(2)]
            for turn, shortest in VARIANTS.values():
                varied = setting._replace(turn=turn, shortest=shortest)
                hits.append([shares(trials, 2, s, varied, samples) for s in SIGMAS])
            verdicts = [verdict(zip(hits[0], hits[1], strict=True))]
            for random in hits[2:]:
                verdicts.append(verdict((a, b) for other in hits[:2] for a, b in zip(other, random, strict=True)))
            verdicts.append(verdict((a, b) for row in hits for a, b in itertools.pairwise(row)))
            totals += np.array([v == "yes" for v in verdicts])
            print(f"| f = {focal:.0f} px, depths {near:g}–{far:g} | " + " | ".join(verdicts) + " |", flush=True)
    print("| settings where it holds | " + " | ".join(f"{n} of {len(FOCALS) * len(DEPTHS)}" for n in totals) + " |")


def shares(trials, pattern, sigma, setting, samples):
    return in_gate(run(trials, trial, pattern, sigma, setting, options=(samples,)))


def verdict(pairs):
    """Is the first share the larger in all pairs? "no" where one is significantly smaller, "open" where not decided."""
    z = []
    for a, b in pairs:
        deviation = np.sqrt((np.var(a) + np.var(b)) / len(a))
        z.append((np.mean(a) - np.mean(b)) / max(deviation, 1e-12))
    return "yes" if min(z) > 1.96 else ("no" if min(z) < -1.96 else "open")


def print_solvers(trials, setting) -> None:
    print(f"\nTwo solvers, float64, {trials} runs: same E to 1e-8; largest difference then; counted by each\n")
    print(header([f"{sigma} px" for sigma in SIGMAS]))
    for i, pattern in enumerate(PATTERNS):
        cells = []
        for sigma in SIGMAS:
            gap, errors = run(trials, difference_of_solvers, i, sigma, setting)
            same = gap < 1e-8
            counts = in_gate(errors).sum(axis=0)
            cells.append(f"{100 * same.mean():.4f} %, {gap[same].max():.1e}; {counts[0]} and {counts[1]}")
        print(f"| {pattern} | " + " | ".join(cells) + " |", flush=True)


def print_selections(trials, setting) -> None:
    print(f"\nWhich error selects the solution nearest to the truth, 1 px, {trials} runs; counted per 100 then\n")
    print(header([*(f"{name}, {judges} points" for judges in (6, 10, 50) for name in SELECTIONS), "best", "solutions"]))
    for i, pattern in enumerate(PATTERNS):
        cells = []
        for judges in (6, 10, 50):
            right, errors, number = run(trials, selections, i, 1.0, setting, judges)
            for k in range(len(SELECTIONS)):
                share, low, high = share_interval(right[:, k])
                cells.append(f"{share:.1f} % ({low:.1f}–{high:.1f}); {100 * in_gate(errors[:, k]).mean():.1f}")
        cells += [f"{100 * in_gate(errors[:, -1]).mean():.1f}", f"{number.mean():.1f}"]
        print(f"| {pattern} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100_000, help="per cell; the grid takes a twenty-fifth")
    parser.add_argument("--grid", action="store_true", help="vary what the source leaves open, and nothing else")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    trials, setting = arguments.trials, Setting()
    print(describe_machine(), f"· {trials} trials a cell")
    if arguments.grid:
        print("\nDoes the ordering hold at all noises? One sample\n")
        ordering(trials // 25, 1)
        return
    table((100, trials), 1, setting)
    table((100, trials // 50), 10, setting)
    print_solvers(trials // 10, setting)
    print_selections(trials // 10, setting)


if __name__ == "__main__":
    main()
