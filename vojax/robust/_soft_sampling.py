"""Minimal samples drawn with learnable weights, and how probable each was.

Adding independent Gumbel noise to the logits and taking the m largest draws m different observations one after the
other, each with probability ∝ exp(logit) among those that are left (Plackett–Luce). A minimal solver does not ask in
which order its observations came, so a sample counts as a set S: its probability is the sum over all m! orders, by

    P(A) = Σ_{i ∈ A} P(A−i) exp(l_i) / Σ_{j ∉ A−i} exp(l_j),    P(∅) = 1,                                    (1)

where A−i is A without i: every subset of S is visited once. The logarithm of P(S) is what the score function
(REINFORCE) differentiates; as a sum over orders it has a lower variance than the probability of the order that happened
to be drawn.

References: W. Kool, H. van Hoof & M. Welling. Stochastic beams and where to find them. ICML 2019. E. Brachmann &
C. Rother. Neural-guided RANSAC. ICCV 2019.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from vojax._types import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

_NEVER = -1e30  # the logit of what cannot be drawn: finite, so that differences of two of them are numbers


def draw_gumbel_samples(
    key: PRNGKeyArray | Array,
    logits: Float[ArrayLike, " n"],
    *,
    num_samples: int,
    sample_size: int,
    mask: Bool[ArrayLike, " n"] | None = None,
) -> tuple[Int[Array, "k m"], Bool[Array, " k"]]:
    """Draw minimal samples without replacement, with probability by their logits.

    Args:
        key: Random key; the same key gives the same samples.
        logits: Of the observations. Equal logits draw uniformly; a constant added to all changes nothing.
        num_samples: Samples k, independent of each other.
        sample_size: Observations m in each.
        mask: False for padding, which is not drawn; nor are observations whose logit is not finite.

    Returns:
        Indices in ascending order, and whether there were observations enough; where there were not, the indices mean
        nothing.

    Differentiability: indices have no derivative; differentiate `sample_log_probability` instead.

    Raises:
        ValueError: If a sample is larger than the data.

    References: see the module.

    Example:
        >>> samples, valid = draw_gumbel_samples(jax.random.key(0), jnp.zeros(6), num_samples=100, sample_size=3)
        >>> samples.shape, bool(valid.all()), bool((jnp.diff(samples, axis=1) > 0).all())
        ((100, 3), True, True)
    """
    logits, allowed = _usable(logits, mask)
    (n,) = logits.shape
    if not 1 <= sample_size <= n:
        raise ValueError(f"samples of {sample_size} from {n} observations; expected between 1 and {n}")
    if num_samples < 1:
        raise ValueError(f"num_samples is {num_samples}; expected at least 1")
    # The default draws no Gumbel number above 16 in float32, and logits of learned weights differ by more.
    noise = jax.random.gumbel(key, (num_samples, n), logits.dtype, mode="high")
    perturbed = jnp.where(allowed[None], jax.lax.stop_gradient(logits)[None] + noise, -jnp.inf)
    _, samples = jax.lax.top_k(perturbed, sample_size)
    enough = jnp.sum(allowed) >= sample_size
    return jnp.sort(samples, axis=1), jnp.broadcast_to(enough, (num_samples,))


def sample_log_probability(
    logits: Float[ArrayLike, " n"], samples: Int[ArrayLike, "k m"], *, mask: Bool[ArrayLike, " n"] | None = None
) -> Float[Array, " k"]:
    """Logarithm of the probability that `draw_gumbel_samples` draws the set, equation (1).

    Args:
        logits: Of the observations.
        samples: Different indices, in any order.
        mask: As for drawing.

    Returns:
        Of each sample. The cost per sample is n + m 2^m.

    Degenerate input: samples that cannot be drawn (padding among them, or too few observations) have 0, with gradient
        0, so that they never count.

    Differentiability: both modes, any order, in the logits.

    References: see the module.

    Example:
        >>> probability = jnp.exp(sample_log_probability(jnp.log(jnp.array([0.5, 0.3, 0.2])), jnp.array([[0, 1]])))
        >>> bool(jnp.allclose(probability, 0.5 * 0.3 / 0.5 + 0.3 * 0.5 / 0.7))
        True
    """
    logits, allowed = _usable(logits, mask)
    samples = jnp.asarray(samples)
    k, m = samples.shape
    possible = jnp.all(allowed[samples], axis=1)
    # A constant changes nothing; without it, exp would overflow.
    logits = jnp.where(allowed, logits - jax.lax.stop_gradient(jnp.max(logits)), _NEVER)
    taken = jnp.zeros((k, logits.shape[0]), bool).at[jnp.arange(k)[:, None], samples].set(True)
    outside = logsumexp(jnp.where(taken, _NEVER, logits[None]), axis=1)  # of all that the sample leaves
    chosen = jnp.where(possible[:, None], logits[samples], 0.0).T
    outside = jnp.where(possible, outside, 0.0)

    log_drawn = jnp.zeros((1, k), logits.dtype)
    for before, item, left in _levels(m):
        # What is left when the set `before` is gone: the rest of the sample and all outside it.
        remaining = jnp.logaddexp(logsumexp(chosen[left], axis=1), outside[None])
        ways = (log_drawn - remaining)[before] + chosen[item]
        log_drawn = logsumexp(ways, axis=1)
    return jnp.where(possible, log_drawn[0], 0.0)


@functools.cache
def _levels(m: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Equation (1) as tables, one step from the subsets of c − 1 items to those of c.

    For each subset of c and each item in it: the row of the subset without the item `[C(m, c), c]`, and the item; and
    for each subset of c − 1 the items that it leaves `[C(m, c − 1), m − c + 1]`.
    """
    subsets = [list(itertools.combinations(range(m), c)) for c in range(m + 1)]
    rows = [{subset: row for row, subset in enumerate(level)} for level in subsets]
    levels = []
    for c in range(1, m + 1):
        before = [[rows[c - 1][subset[:i] + subset[i + 1 :]] for i in range(c)] for subset in subsets[c]]
        left = [[i for i in range(m) if i not in subset] for subset in subsets[c - 1]]
        levels.append(tuple(np.array(table, np.int32) for table in (before, subsets[c], left)))
    return levels


def _usable(logits: Float[ArrayLike, " n"], mask: Bool[ArrayLike, " n"] | None) -> tuple[Array, Bool[Array, " n"]]:
    """Logits with `_NEVER` for observations that cannot be drawn, and which can."""
    logits = jnp.asarray(logits)
    if logits.ndim != 1:
        raise ValueError(f"logits have shape {logits.shape}; expected one number for each observation, (n,)")
    allowed = jnp.isfinite(logits)
    if mask is not None:
        mask = jnp.asarray(mask)
        if mask.shape != logits.shape:
            raise ValueError(f"the mask has shape {mask.shape} and the logits {logits.shape}; expected the same")
        allowed = allowed & mask
    return jnp.where(allowed, logits, _NEVER), allowed
