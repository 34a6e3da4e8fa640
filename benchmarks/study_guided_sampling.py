"""Guided against uniform sampling: how many hypotheses a search needs, over how much the quality of matches tells.

Claims: the number of samples that a search needs is N = log(1 - p) / log(1 - w^m) (Scaramuzza & Fraundorfer 2011;
Marković's lecture; Aufderheide, Krybus & Edwards 2012); samples taken in the order of a quality
τ = w_ξ ξ + w_ρ ρ of the corner's score ξ and the match's score ρ need fewer (Aufderheide et al., algorithm 1).

200 matches; ξ and ρ of wrong matches are standard normal, of right ones shifted by a separation. `match_quality` adds
their ranks with equal weights, `draw_minimal_samples` draws samples of five in the order of PROSAC. A sample without a
wrong match counts as success. How much the quality tells is its correlation with being right.

Algorithm 1 prints `while (d_e < d_lim) and (g <= N) and (h > h_lim)`: it goes on while the error d_e is small and the
inliers h are many. The last table runs the loop as printed, and with the two tests of the model negated.

At last `estimate_relative_pose` as it is, with and without quality: right means 10° of translation and 2° of rotation.

python benchmarks/study_guided_sampling.py [--trials N] [--problems N]
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np
from _timing import describe_machine

from vojax import estimate_relative_pose
from vojax.datasets import simulate_relative_pose
from vojax.metrics import rotation_error_deg, translation_direction_error_deg
from vojax.robust import draw_minimal_samples, match_quality, required_hypotheses

MATCHES, LARGEST, CHUNK = 200, 4096, 100
OUTLIERS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
SEPARATIONS = (0.0, 0.5, 1.0, 1.5, 2.0)
BUDGETS = (100, 1000, 4096)


def scores(key, right, separation):
    """Quality of each match, and its correlation with being right."""
    score, other = jax.random.normal(key, (2, len(right))) + separation * right[None]
    quality = match_quality(score, other)
    return quality, jnp.corrcoef(quality, right)[0, 1]


def trial(key, outliers, separation, sample_size, guided):
    """Index of the first good sample (LARGEST if none), of the first bad one, and the correlation."""
    keys = jax.random.split(key, 2)
    right = 1.0 * (jnp.arange(MATCHES) >= jnp.round(outliers * MATCHES))
    quality, correlation = scores(keys[0], right, separation)
    samples = draw_minimal_samples(
        keys[1], MATCHES, num_samples=LARGEST, sample_size=sample_size, quality=quality if guided else None
    )
    good = jnp.all(right[samples] > 0, axis=1)
    first_good = jnp.where(good.any(), jnp.argmax(good), LARGEST)
    return first_good, jnp.where(good.all(), LARGEST, jnp.argmin(good)), correlation


@functools.partial(jax.jit, static_argnums=(2,))
def solve(keys, arguments, options):
    return jax.lax.map(lambda key: trial(key, *arguments, *options), keys, batch_size=CHUNK)


def run(trials, outliers, separation, sample_size=5, guided=True):
    return [
        np.asarray(x)
        for x in solve(jax.random.split(jax.random.key(0), trials), (outliers, separation), (sample_size, guided))
    ]


def share(hits):
    """A share with its 95 % interval (Wilson), per cent."""
    z, n, p = 1.96, len(hits), np.mean(hits)
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + (z / (2 * n)) ** 2)
    low, high = (100 * (middle + sign * half) / (1 + z * z / n) for sign in (-1, 1))
    return f"{100 * p:.1f} ({low:.1f}–{high:.1f})"


def median(first):
    """Hypotheses until the first good one: median with its 95 % interval."""
    ordered, n, half = np.sort(first) + 1, len(first), 0.98 * np.sqrt(len(first))
    middle, low, high = ordered[np.clip((0.5 * n + np.array([0.0, -half, half])).astype(int), 0, n - 1)]
    return f"> {LARGEST}" if middle > LARGEST else f"{middle} ({low}–{high if high <= LARGEST else '…'})"


@functools.partial(jax.jit, static_argnums=(3,))
def estimates(keys, problems, separation, guided):
    """Errors of robust estimates in degrees, and the hypotheses they took."""

    def one(key, problem):
        keys = jax.random.split(key)
        quality, _ = scores(keys[0], 1.0 * problem.inliers, separation)
        found = estimate_relative_pose(
            problem.pixels0,
            problem.pixels1,
            problem.camera,
            problem.camera,
            key=keys[1],
            quality=quality if guided else None,
        )
        true, pose = problem.cam1_from_cam0, found.model
        shift = translation_direction_error_deg(pose.translation(), true.translation())
        return shift, rotation_error_deg(pose.rotation(), true.rotation()), found.num_hypotheses

    return jax.vmap(one)(keys, problems)


def header(first, columns):
    return f"| {first} | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|"


def print_required(trials) -> None:
    # Observations of a sample are all different, which the formula neglects.
    print("\nN(p, w, m); per 100 searches of N uniform samples those with a good one (95 %); as many as expected\n")
    confidences = (0.9, 0.99, 0.999)
    print(header("", [f"p = {p}: N; measured; expected" for p in confidences]))
    for m in (3, 5, 7):
        for w in (0.4, 0.5, 0.7):
            first, _, _ = run(trials, 1.0 - w, 0.0, m, False)
            counts = [int(required_hypotheses(w, m, p)) for p in confidences]
            right = np.round(w * MATCHES) - np.arange(m)
            good = np.prod(right / (MATCHES - np.arange(m)))
            cells = []
            for n in counts:
                measured = share(first < n) if n <= LARGEST else "more than drawn"
                cells.append(f"{n}; {measured}; {100 * (1 - (1 - good) ** n):.1f}")
            print(f"| m = {m}, w = {w} | " + " | ".join(cells) + " |", flush=True)


def print_guided(trials) -> None:
    results = {"uniform": [run(trials, o, 0.0, guided=False) for o in OUTLIERS]}
    for separation in SEPARATIONS:
        results[f"guided, {separation} σ"] = [run(trials, o, separation) for o in OUTLIERS]
    columns = [f"{100 * o:.0f} % wrong" for o in OUTLIERS]
    print("\nCorrelation of the quality with being right\n\n" + header("", columns))
    for name, row in list(results.items())[1:]:
        print(f"| {name} | " + " | ".join(f"{cell[2].mean():.2f}" for cell in row) + " |")
    print("\nHypotheses until one is free of wrong matches: median (95 %)\n\n" + header("", columns))
    for name, row in results.items():
        print(f"| {name} | " + " | ".join(median(cell[0]) for cell in row) + " |")
    for budget in BUDGETS:
        print(f"\nPer 100 searches of {budget} hypotheses those with a good one (95 %)\n\n" + header("", columns))
        for name, row in results.items():
            print(f"| {name} | " + " | ".join(share(cell[0] < budget) for cell in row) + " |")


def print_loop(trials) -> None:
    print("\nThe loop of algorithm 1, at most 1000 hypotheses: mean number drawn, per 100 that end on a good model\n")
    print(header("", [f"{100 * o:.0f} % wrong" for o in OUTLIERS]))
    both = [run(trials, o, 0.0, guided=False) for o in OUTLIERS]
    for name, k in (("as printed", 1), ("negated", 0)):
        cells = []
        for results in both:
            stopped = results[k]
            ends = stopped < 1000
            # As printed the loop leaves with the first bad model; only if all were good, with a good one.
            cells.append(f"{np.minimum(stopped + 1, 1000).mean():.3g}; {share(ends if k == 0 else ~ends)}")
        print(f"| {name} | " + " | ".join(cells) + " |")


def print_estimates(problems) -> None:
    outliers = (0.5, 0.7, 0.8)
    print(f"\nRobust relative poses, {problems} problems: per 100 right (95 %); median and mean number of hypotheses\n")
    print(header("", [f"{100 * o:.0f} % wrong" for o in outliers]))
    keys = jax.random.split(jax.random.key(3), problems)
    for name, separation, guided in (("uniform", 0.0, False), *((f"guided, {s} σ", s, True) for s in (0.0, 1.0, 2.0))):
        cells = []
        for o in outliers:
            draw = jax.vmap(lambda key, o=o: simulate_relative_pose(key, MATCHES, outlier_fraction=o))
            shift, turn, drawn = (np.asarray(x) for x in estimates(keys, draw(keys), separation, guided))
            right = (shift < 10.0) & (turn < 2.0)
            cells.append(f"{share(right)}; {np.median(drawn):.0f}, {drawn.mean():.0f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=2_000, help="per cell")
    parser.add_argument("--problems", type=int, default=300, help="of robust estimation")
    arguments = parser.parse_args()
    print(describe_machine(), f"· {arguments.trials} trials a cell")
    print_required(arguments.trials)
    print_guided(arguments.trials)
    print_loop(arguments.trials)
    print_estimates(arguments.problems)


if __name__ == "__main__":
    main()
