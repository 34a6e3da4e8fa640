"""What linear two-view solvers share: normalisation, epipolar rows, least vectors with a measure of their certainty.

Every correspondence is one row r of x1ᵀ M x0 = r · m, with m the entries of M row by row. In float32 AᵀA would cost
half of the digits: for 10 exact bearings its least eigenvector is off by 3.5e-3 in one case of a hundred, that of a QR
decomposition by 4e-6 (n = 20: 2e-4 and 8e-7). So reflections are used throughout, and AᵀA nowhere.

References: G. Golub, C. Van Loan. Matrix Computations, 4th edition, sections 5.2 and 8.2. R. Hartley. In defense of the
eight-point algorithm. PAMI 1997.
"""

import jax
import jax.numpy as jnp

from vojax._numerics import dot3, lane_sum, normalize, safe_divide
from vojax._types import Array, ArrayLike, Bool, Float

from ._components import Components, Rows3, floor, sign, squared

# Singular values below these, in units of eps, are rounding: the least one of 7 or 8 unit rows, and the second least
# one of a tall matrix relative to all of them together. The first reaches 1.5 eps for bearings of points on a plane
# (3.6 eps for pixels, at twice the error); of points in general position it falls below 10 eps of float32 in one set of
# eight of 10,000.
DEPENDENT_ROWS = 4.0
REPEATED_LEAST = 64.0


def dependent(least: Float[Array, "*lanes"], rounding: Float[Array, "*lanes"] | float = 1.0) -> Bool[Array, "*lanes"]:
    """Whether rows with this least singular value, and errors in units of eps, leave more than their null space."""
    return ~(least > DEPENDENT_ROWS * float(jnp.finfo(least.dtype).eps) * rounding)


def repeated(second: Float[Array, "*lanes"]) -> Bool[Array, "*lanes"]:
    """Whether rounding leaves more than one least vector."""
    return ~(second > REPEATED_LEAST * float(jnp.finfo(second.dtype).eps))


def unit_rays(rays: Float[Array, "n 3 *lanes"]) -> tuple[Components, Bool[Array, "*lanes"]]:
    """Components [n, *lanes] of unit bearings, and whether all rays of a problem have a usable length."""
    x = (rays[:, 0], rays[:, 1], rays[:, 2])
    norm2 = squared(x)
    usable = (norm2 > floor(norm2) ** 2) & (norm2 < 1.0 / floor(norm2) ** 2)
    norm = jnp.sqrt(jnp.where(usable, norm2, 1.0))
    return tuple(jnp.where(usable, c / norm, 0.0) for c in x), jnp.all(usable, axis=0)


def centred_pixels(
    pixels: Float[Array, "n 2 *lanes"], weights: Float[Array, "n *lanes"]
) -> tuple[Components, Components, Bool[Array, "*lanes"]]:
    """Hartley's normalisation: centroid 0 and mean distance √2, in the mean that the weights define.

    Returns:
        Homogeneous components [n, *lanes] of the normalised points; (s, cx, cy) with x = s (pixel - c); and whether the
        points have any spread. Components are quotients, which XLA keeps and does not recompute in every consumer.
    """
    finite = jnp.all(jnp.isfinite(pixels), axis=(0, 1))
    pixels = jnp.where(finite, pixels, 0.0)
    total = lane_sum(weights, axis=0)
    share = weights / jnp.where(total > 0, total, 1.0)[None]
    # Relative to one of them first: the mean of large, close numbers rounds.
    base = pixels[0]
    moved = pixels - base[None]
    mean = lane_sum(share[:, None] * moved, axis=0)
    moved = moved - mean[None]
    norm2 = moved[:, 0] * moved[:, 0] + moved[:, 1] * moved[:, 1]
    apart = norm2 > floor(norm2) ** 3
    spread = lane_sum(share * jnp.where(apart, jnp.sqrt(jnp.where(apart, norm2, 1.0)), 0.0), axis=0)
    largest = jnp.max(jnp.abs(pixels), axis=(0, 1))
    rounding = 16.0 * float(jnp.finfo(pixels.dtype).eps) * largest
    usable = finite & (spread > floor(spread)) & (largest < 1.0 / floor(spread)) & (spread > rounding)
    radius = 0.5**0.5 * jnp.where(usable, spread, 1.0)
    s = 1.0 / radius
    x, y = (jnp.where(usable, moved[:, i], 0.0) / radius[None] for i in range(2))
    return (x, y, jnp.ones_like(x)), (s, base[0] + mean[0], base[1] + mean[1]), usable


def normalised_from_pixel(transform: Components) -> Rows3:
    """Matrix of Hartley's normalisation as rows of components."""
    s, cx, cy = transform
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    return (s, zero, -s * cx), (zero, s, -s * cy), (zero, zero, one)


def whitened(x: Components, weights: Float[Array, "n *lanes"]) -> tuple[Components, Rows3]:
    """Bearings times the inverse of the Cholesky factor of their second moments, and that inverse as rows."""
    total = lane_sum(weights, axis=0)
    share = weights / jnp.where(total > 0, total, 1.0)[None]
    m = [[lane_sum(share * x[i] * x[j], axis=0) for j in range(i + 1)] for i in range(3)]
    # The trace is 1; bearings on a plane through the centre leave the last pivot at rounding.
    least = float(jnp.finfo(total.dtype).eps)
    l00 = jnp.sqrt(jnp.maximum(m[0][0], least))
    l10, l20 = m[1][0] / l00, m[2][0] / l00
    l11 = jnp.sqrt(jnp.maximum(m[1][1] - l10 * l10, least))
    l21 = (m[2][1] - l20 * l10) / l11
    l22 = jnp.sqrt(jnp.maximum(m[2][2] - l20 * l20 - l21 * l21, least))
    zero = jnp.zeros_like(l00)
    a, c, f = 1.0 / l00, 1.0 / l11, 1.0 / l22
    b = -l10 * a * c
    d, e = (l10 * l21 * a * c - l20 * a) * f, -l21 * c * f
    rows = ((a, zero, zero), (b, c, zero), (d, e, f))
    return transformed(rows, x), rows


def transformed(rows: Rows3, x: Components) -> Components:
    """Matrix, by components [*lanes], times vectors [n, *lanes]."""
    return tuple(dot3((row[0][None], row[1][None], row[2][None]), x) for row in rows)


def congruent(rows1: Rows3, matrix: Rows3, rows0: Rows3) -> Rows3:
    """T1ᵀ M T0 by components: the matrix that M, found for T x, is for x."""
    half = [[dot3(matrix[i], (rows0[0][j], rows0[1][j], rows0[2][j])) for j in range(3)] for i in range(3)]
    rows = [
        tuple(rows1[0][i] * half[0][j] + rows1[1][i] * half[1][j] + rows1[2][i] * half[2][j] for j in range(3))
        for i in range(3)
    ]
    return rows[0], rows[1], rows[2]


def epipolar_rows(x0: Components, x1: Components) -> Float[Array, "n 9 *lanes"]:
    """Rows3 r with r · m = x1ᵀ M x0."""
    return jnp.stack([x1[i] * x0[j] for i in range(3) for j in range(3)], axis=1)


def unit_points(x: Components) -> Components:
    """Vectors [n, *lanes] scaled to length 1; their products are rows of length 1."""
    norm = jnp.sqrt(squared(x))
    return tuple(c / norm for c in x)


def pixel_rounding(pixels: Float[Array, "n 2 *lanes"], transform: Components) -> Float[Array, "*lanes"]:
    """Rounding error of centred pixels in units of eps: the offset that was subtracted, in Hartley's unit."""
    return 1.0 + transform[0] * jnp.max(jnp.abs(pixels), axis=(0, 1))


def matrix_rows(entries: Float[Array, "9 *lanes"]) -> Rows3:
    """Nine entries as rows of components."""
    return (
        (entries[0], entries[1], entries[2]),
        (entries[3], entries[4], entries[5]),
        (entries[6], entries[7], entries[8]),
    )


def null_space_and_least(
    rows: Float[Array, "m c *lanes"],
) -> tuple[Float[Array, "q c *lanes"], Float[Array, "*lanes"]]:
    """Orthonormal basis of the null space of m < c unit rows, and their least singular value.

    As `null_space`. The reflections also leave the triangle L of A = L Qᵀ, and one step of inverse iteration with L Lᵀ
    estimates the least singular value. Short of that, the least distance of a row from the span of those before it was
    above 64 eps in one of a hundred sets of seven points on a plane.
    """
    m, columns = rows.shape[:2]
    eps = float(jnp.finfo(rows.dtype).eps)
    reflectors: list[tuple[Array, Array]] = []
    pivots: list[Array] = []
    below: list[Array] = []
    rest = rows
    for k in range(m):
        x = rest[0]
        length = jnp.sqrt(lane_sum(x * x, axis=0))
        usable = length > floor(length) ** 2
        alpha = -sign(x[0]) * length
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        beta = jnp.where(usable, 1.0 / jnp.where(usable, length * length - alpha * x[0], 1.0), 0.0)
        reflectors.append((v, beta))
        pivots.append(jnp.where(length > 0.25 * eps, alpha, 0.25 * eps))
        if k < m - 1:
            along = lane_sum(rest[1:] * v[None], axis=1) * beta[None]
            rest = rest[1:] - along[:, None] * v[None]
            below.append(rest[:, 0])
            rest = rest[:, 1:]

    y = jnp.broadcast_to(
        jnp.asarray(_STARTS[0][:m], rows.dtype).reshape((m,) + (1,) * (rows.ndim - 2)), (m, *rows.shape[2:])
    )
    forward = []
    for k in range(m):
        forward.append(y[0] / pivots[k])
        if k < m - 1:
            y = y[1:] - below[k] * forward[k][None]
    image = jnp.stack(forward)
    image = image / jnp.max(jnp.abs(image), axis=0)[None]
    back = image[m - 1 :] / pivots[m - 1][None]
    for k in range(m - 2, -1, -1):
        entry = (image[k] - lane_sum(below[k] * back, axis=0)) / pivots[k]
        back = jnp.concatenate([entry[None], back])
    least = jnp.sqrt(lane_sum(image * image, axis=0)) / jnp.sqrt(lane_sum(back * back, axis=0))

    q = columns - m
    basis = jnp.eye(q, dtype=rows.dtype).reshape(q, q, *(1,) * (rows.ndim - 2))
    basis = jnp.broadcast_to(basis, (q, q, *rows.shape[2:]))
    for v, beta in reversed(reflectors):
        basis = jnp.concatenate([jnp.zeros_like(basis[:, :1]), basis], axis=1)
        along = lane_sum(basis * v[None], axis=1) * beta[None]
        basis = basis - along[:, None] * v[None]
    return basis, least


def least_vector_and_second(
    rows: Float[Array, "n c *lanes"], steps: int
) -> tuple[Float[Array, "c *lanes"], Float[Array, "*lanes"]]:
    """Unit vector that minimises |A v| for n >= c rows, and the second least singular value relative to |A|.

    A = Q R by Householder reflections; then inverse iteration on RᵀR with two vectors, which also bounds the second
    least singular value; it is 0 for a matrix that is zero or not finite. The vector's error falls by
    (σ_last / σ_third_last)² in each step.
    """
    columns = rows.shape[1]
    eps = float(jnp.finfo(rows.dtype).eps)
    total = jnp.sqrt(lane_sum(rows * rows, axis=(0, 1)))
    proper = jnp.isfinite(total) & (total > floor(total))
    scale = jnp.where(proper, total, 1.0)
    rest = jnp.where(proper, rows / scale[None, None], 0.0)
    pivots: list[Array] = []
    tails: list[Array] = []
    for _ in range(columns):
        x = rest[:, 0]
        length = jnp.sqrt(lane_sum(x * x, axis=0))
        usable = length > floor(length) ** 2
        length = jnp.where(usable, length, 1.0)
        alpha = -sign(x[0]) * length
        v = jnp.concatenate([(x[0] - alpha)[None], x[1:]])
        beta = jnp.where(usable, 1.0 / (length * length - alpha * x[0]), 0.0)
        along = lane_sum(rest[:, 1:] * v[:, None], axis=0) * beta[None]
        rest = rest[:, 1:] - v[:, None] * along[None]
        pivots.append(jnp.where(usable, alpha, 0.0))
        tails.append(rest[0])
        rest = rest[1:]
    # A pivot at rounding is as good as any other there; it makes the iteration converge in one step.
    safe = [jnp.where(jnp.abs(pivot) > 2.0 * eps, pivot, 2.0 * eps) for pivot in pivots]

    def solve(x: Array) -> Array:
        """(RᵀR)⁻¹ x, scaled on the way so that nothing overflows."""
        forward = []
        for pivot, tail in zip(safe, tails, strict=True):
            entry = x[0] / pivot
            forward.append(entry)
            x = x[1:] - tail * entry[None]
        y = _unit(jnp.stack(forward))
        back = jnp.zeros_like(x)
        for k in range(columns - 1, -1, -1):
            entry = (y[k] - lane_sum(tails[k] * back, axis=0)) / safe[k]
            back = jnp.concatenate([entry[None], back])
        return _unit(back)

    def image(x: Array) -> Array:
        return jnp.stack([pivots[k] * x[k] + lane_sum(tails[k] * x[k + 1 :], axis=0) for k in range(columns)])

    def across(y: Array, x: Array) -> Array:
        """The part of y that is orthogonal to x, of unit length."""
        rest = y - lane_sum(x * y, axis=0)[None] * x
        # A clear null vector draws both iterates onto itself, now and then to the last bit: then any other vector.
        along = [lane_sum(x * start, axis=0) for start in starts]
        spare = jnp.where((jnp.abs(along[0]) < jnp.abs(along[1]))[None], starts[0], starts[1])
        lost = lane_sum(rest * rest, axis=0) < (64.0 * eps) ** 2
        rest = _unit(jnp.where(lost[None], spare - lane_sum(x * spare, axis=0)[None] * x, rest))
        return _unit(rest - lane_sum(x * rest, axis=0)[None] * x)

    def iterate(_: object, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, y, second = state
        x = solve(x)
        y = across(solve(y), x)
        # One Jacobi rotation makes the images orthogonal, the shorter one first.
        rx, ry = image(x), image(y)
        gamma = 2.0 * lane_sum(rx * ry, axis=0)
        delta = lane_sum(ry * ry, axis=0) - lane_sum(rx * rx, axis=0)
        denominator = jnp.abs(delta) + jnp.sqrt(delta * delta + gamma * gamma)
        usable = denominator > floor(denominator) ** 3
        tangent = jnp.where(usable, sign(delta) * gamma / jnp.where(usable, denominator, 1.0), 0.0)
        cosine = 1.0 / jnp.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        x, y = cosine[None] * x - sine[None] * y, sine[None] * x + cosine[None] * y
        rx, ry = (jnp.sqrt(lane_sum(image(z) ** 2, axis=0)) for z in (x, y))
        swap = (ry < rx)[None]
        # Any orthonormal pair bounds the second least singular value; rounding in nearly parallel ones is now and then
        # large.
        return jnp.where(swap, y, x), jnp.where(swap, x, y), jnp.minimum(second, jnp.maximum(rx, ry))

    # Irregular, so that they are not orthogonal to the singular vectors of symmetric configurations.
    both = jnp.asarray(_STARTS, rows.dtype)[:, :columns].reshape((2, columns) + (1,) * (rows.ndim - 2))
    starts = [jnp.broadcast_to(start, rows.shape[1:]) for start in both]
    x, y = starts
    x, y, second = jax.lax.fori_loop(0, steps, iterate, (x, y, jnp.full_like(total, jnp.inf)))
    return x, jnp.where(proper, second, 0.0)


_STARTS = (
    (0.31, 0.83, -0.27, 0.52, -0.71, 0.19, 0.43, -0.64, 0.91, -0.36),
    (-0.58, 0.21, 0.77, -0.34, 0.12, 0.88, -0.49, 0.26, 0.37, 0.69),
)


def _unit(x: Array) -> Array:
    largest = jnp.max(jnp.abs(x), axis=0)
    x = x / jnp.where(largest > 0, largest, 1.0)[None]
    norm2 = lane_sum(x * x, axis=0)
    return x / jnp.sqrt(jnp.where(norm2 > 0, norm2, 1.0))[None]


# What follows is for the equations that define derivatives: one problem, few operations on whole arrays, which compile
# several times faster than components.


def matmul(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Product of two matrices, elementwise so that a batch vectorises."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def cofactors(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Matrix of cofactors."""
    a, b = jnp.roll(m, -1, 0), jnp.roll(m, -2, 0)
    return jnp.roll(a, -1, 1) * jnp.roll(b, -2, 1) - jnp.roll(a, -2, 1) * jnp.roll(b, -1, 1)


def algebraic_errors(x0: Float[Array, "n 3"], x1: Float[Array, "n 3"], m: Float[Array, "3 3"]) -> Float[Array, "n"]:
    """x1ᵀ M x0 of each correspondence."""
    return jnp.sum(x1 * jnp.sum(x0[:, None, :] * m[None, :, :], axis=2), axis=1)


def linear_stationarity(
    x0: Float[Array, "n 3"], x1: Float[Array, "n 3"], weights: Float[Array, "n"], m: Float[Array, "3 3"]
) -> Float[Array, "8"]:
    """Eight equations of the unit matrix that minimises the sum of w (x1ᵀ M x0)².

    They are the part of the gradient along the unit sphere at M, in the basis of `perturb_unit_matrix`.
    """
    share = safe_divide(weights, jnp.broadcast_to(jnp.sum(weights), weights.shape))
    error = share * algebraic_errors(x0, x1, m)
    gradient = jnp.sum((error[:, None] * x1)[:, :, None] * x0[:, None, :], axis=0)
    along = (gradient - jnp.sum(gradient * m) * m).reshape(9)
    held = jax.lax.stop_gradient(m).reshape(9)
    v = held.at[0].add(jnp.where(held[0] < 0, -1.0, 1.0))
    return (along - v * (2.0 * jnp.sum(v * along) / jnp.maximum(jnp.sum(v * v), 1e-6)))[1:]


def normalised_fundamental(
    fundamental: Float[Array, "3 3"], transform0: Components, transform1: Components
) -> Float[Array, "3 3"]:
    """One fundamental matrix in Hartley's coordinates, scaled to norm 1."""
    (s0, *c0), (s1, *c1) = transform0, transform1
    one = jnp.ones_like(s0)
    last = jnp.sum(fundamental * jnp.stack([*c0, one])[None, :], axis=1)
    half = jnp.concatenate([fundamental[:, :2] / s0, last[:, None]], axis=1)
    last = jnp.sum(half * jnp.stack([*c1, one])[:, None], axis=0)
    return normalize(jnp.concatenate([half[:2] / s1, last[None, :]], axis=0).reshape(9)).reshape(3, 3)


def two_views(
    first: ArrayLike, second: ArrayLike, weights: ArrayLike | None, at_least: int
) -> tuple[Array, Array, Array]:
    """Arrays of one dtype, weights filled in; refuses what cannot be matched or is too little."""
    first, second = jnp.asarray(first), jnp.asarray(second)
    if first.shape != second.shape:
        raise ValueError(f"found {first.shape} and {second.shape} in the two views; expected equal shapes")
    if first.shape[0] < at_least:
        raise ValueError(f"found {first.shape[0]} correspondences; expected at least {at_least}")
    weights = jnp.ones(first.shape[:1], first.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != first.shape[:1]:
        raise ValueError(f"found weights of shape {weights.shape}; expected one per correspondence, {first.shape[:1]}")
    dtype = jnp.result_type(first, second, weights)
    return first.astype(dtype), second.astype(dtype), weights.astype(dtype)
