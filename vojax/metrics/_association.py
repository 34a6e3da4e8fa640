"""Pair the poses of two trajectories by time."""

import numpy as np

from vojax._types import ArrayLike, Float, Int


def associate(
    times_a: Float[ArrayLike, "n"], times_b: Float[ArrayLike, "m"], max_difference_s: float = 0.01
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Pair timestamps that lie closest together, each used at most once.

    Every time of the shorter list takes its nearest neighbour in the longer one (the earlier of two equally near);
    where several want the same neighbour, the nearest of them gets it and the others stay alone.

    Args:
        times_a: Seconds, increasing.
        times_b: Seconds, increasing.
        max_difference_s: Pairs further apart than this many seconds are dropped.

    Returns:
        Indices into `times_a` and into `times_b`, both increasing; empty where nothing matches.

    Example:
        >>> a, b = associate(np.array([0.0, 1.0, 2.0]), np.array([0.001, 0.5, 0.9, 1.995]), max_difference_s=0.02)
        >>> a.tolist(), b.tolist()
        ([0, 2], [0, 3])
    """
    a = np.asarray(times_a, dtype=np.float64)
    b = np.asarray(times_b, dtype=np.float64)
    if b.size > a.size:
        in_a, in_b = _nearest(a, b, max_difference_s)
    else:
        in_b, in_a = _nearest(b, a, max_difference_s)
    return in_a, in_b


def _nearest(short: np.ndarray, long: np.ndarray, max_difference_s: float) -> tuple[np.ndarray, np.ndarray]:
    if short.size == 0 or long.size == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(long, short, side="right"), 0, long.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(long[after] - short) < np.abs(short - long[before]), after, before)
    difference = np.abs(long[nearest] - short)
    index = np.flatnonzero(difference <= max_difference_s)
    # Rank the claims on each neighbour by distance; the first claim wins.
    order = index[np.lexsort((difference[index], nearest[index]))]
    _, first = np.unique(nearest[order], return_index=True)
    chosen = np.sort(order[first])
    return chosen, nearest[chosen]
