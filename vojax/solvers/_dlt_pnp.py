"""Camera from six points or more by linear equations (direct linear transformation).

A ray q_i meets its point if q_i x P X_i = 0 for the projection matrix P = K [R | t], X homogeneous. That is linear in
the twelve entries of P: two equations a point, solved in the least-squares sense in one of three forms:

    svd      rows u P_3 X - P_1 X, v P_3 X - P_2 X;  P is the null vector, |P| = 1
    fix_p23  the same rows;  P_34 (counted from 0: p23) = 1, and eleven unknowns remain
    cross    all of q x P X for unit q: sin² of the angle at the camera, times the squared distance;  |P| = 1

All in normalised coordinates (points and pixels centred and scaled), for which p23 is the depth of the centroid of the
points: it never vanishes, while that of the world's origin may. The null vector is refined by the residuals themselves
and not by their Gram matrix, which keeps float32 accurate (corrected seminormal equations). RQ decomposition then takes
K and R apart. With bearings, K = I, the left block of P is a multiple of a rotation only without noise: it is replaced
by the nearest rotation, and the result is a start for refinement, not an optimum.

Precondition: the points are not in one plane, nor on a twisted cubic with the camera.

References:
    R. Hartley, A. Zisserman. Multiple View Geometry, chapter 7.
    Å. Björck. Stability analysis of the method of seminormal equations. Linear Algebra and its Applications 1987.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vojax._numerics import cross3, dot3, safe_divide, safe_sqrt
from vojax._types import Array, ArrayLike, Float
from vojax.geometry._rq import rq_components, triangle
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import floor, quaternion_from_rotation, rotate, sign, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._svd3 import svd3
from ._symmetric import diagonal_sum, least_eigenvectors, swept_inverse

METHODS = ("svd", "fix_p23", "cross")
Data = tuple[Array, Array, Array]


class ProjectiveCamera(NamedTuple):
    """A pinhole camera with its pose.

    Attributes:
        cam_from_world: The pose.
        calibration: K, upper triangular with fx, skew, cx, fy, cy in pixels; positive diagonal, last entry 1.
    """

    cam_from_world: SE3
    calibration: Float[Array, "*batch 3 3"]


# What follows takes arrays `[n, d, *lanes]` and weights `[n, *lanes]`; without lanes it serves the derivative.


def normalisation(x: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean `[d, *lanes]`, and the factor that makes the spread about it sqrt(d)."""
    total = jnp.sum(weights, axis=0)
    relative = x - x[:1]  # so that far from the origin the mean does not round
    mean = jnp.sum(weights[:, None] * relative, axis=0)
    mean = safe_divide(mean, jnp.broadcast_to(total[None], mean.shape))
    spread = jnp.sum(weights[:, None] * (relative - mean[None]) ** 2, axis=(0, 1))
    factor = safe_sqrt(safe_divide(x.shape[1] * total, spread))
    return x[0] + mean, jnp.where(factor > 0, factor, 1.0)


def homogeneous(x: Array) -> Array:
    """A last row of ones."""
    return jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1)


def across(rays: Array, unit: bool) -> Array:
    """Symmetric matrices S = Σ s sᵀ over the directions s across a ray, as `[3, 3, n, *lanes]`.

    For unit rays these are two unit vectors, S = I - q qᵀ; otherwise (1, 0, -u) and (0, 1, -v) of q = (u, v, 1).
    """
    x, y, z = rays[:, 0], rays[:, 1], rays[:, 2]
    if unit:
        rows = [[y * y + z * z, -x * y, -x * z], [-x * y, x * x + z * z, -y * z], [-x * z, -y * z, x * x + y * y]]
    else:
        one, zero = jnp.ones_like(x), jnp.zeros_like(x)
        rows = [[one, zero, -x], [zero, one, -y], [-x, -y, x * x + y * y]]
    return jnp.stack([jnp.stack(row) for row in rows])


def gram_matrix(s: Array, a: Array, weights: Array) -> Array:
    """Σ w S ⊗ a aᵀ, `[3 m, 3 m, *lanes]`, for the unknowns P of the rows S P a, with a `[n, m, *lanes]`."""
    m = a.shape[1]
    a = jnp.moveaxis(a, 1, 0)
    left = jnp.stack([s[i, j] * weights for i in range(3) for j in range(i + 1)])
    right = jnp.stack([a[i] * a[j] for i in range(m) for j in range(i + 1)])
    sums = jnp.sum(left[:, None] * right[None], axis=2)

    def place(i: int, j: int) -> int:
        return max(i, j) * (max(i, j) + 1) // 2 + min(i, j)

    first = jnp.array([[place(r // m, c // m) for c in range(3 * m)] for r in range(3 * m)])
    second = jnp.array([[place(r % m, c % m) for c in range(3 * m)] for r in range(3 * m)])
    return sums[first, second]


def gram_times(s: Array, a: Array, weights: Array, p: Array) -> Array:
    """That matrix times P `[3 m, *lanes]`, by way of the residuals: their rounding is that of small numbers."""
    m = a.shape[1]
    y = jnp.stack([jnp.sum(p[m * r : m * r + m][None] * a, axis=1) for r in range(3)])  # [3, n, *lanes]
    residual = jnp.sum(s * y[None], axis=1) * weights[None]
    return jnp.sum(residual[:, :, None] * a[None], axis=1).reshape(p.shape)


def reflection(p: Array) -> Callable[[Array], Array]:
    """The Householder reflection that exchanges a unit vector with ± the first axis, along the first axis of arrays."""
    v = jnp.concatenate([(p[0] + sign(p[0]))[None], p[1:]])
    beta = 2.0 / jnp.maximum(jnp.sum(v * v, axis=0), 1.0)

    def reflect(x: Array) -> Array:
        lead = (slice(None),) + (None,) * (x.ndim - v.ndim)
        return x - v[lead] * (beta * jnp.sum(v[lead] * x, axis=0))[None]

    return reflect


def _least_vector(s: Array, a: Array, weights: Array, fixed: bool) -> tuple[Array, Array]:
    """Unit vector P that minimises P·G P at |P| = 1, or at fixed last entry; and whether it is the only one."""
    gram = gram_matrix(s, a, weights)
    if fixed:
        inverse, regular = swept_inverse(gram[:11, :11])
        start = jnp.concatenate([jnp.zeros_like(gram[:11, 0]), jnp.ones_like(gram[:1, 0])])

        def improve(_: object, p: Array) -> Array:
            step = jnp.sum(inverse * gram_times(s, a, weights, p)[None, :11], axis=1)
            return p - jnp.concatenate([step, jnp.zeros_like(step[:1])])

        p = jax.lax.fori_loop(0, 3, improve, start)
        return p / jnp.sqrt(jnp.sum(p * p, axis=0))[None], regular

    start = least_eigenvectors(gram, 1)[0]
    # With its null vector made as heavy as the others, the matrix is regular unless it has another one.
    mean = diagonal_sum(gram) / 12.0
    inverse, regular = swept_inverse(gram + start[:, None] * start[None] * mean[None, None])

    def improve(_: object, p: Array) -> Array:
        y = gram_times(s, a, weights, p)
        y = y - jnp.sum(p * y, axis=0)[None] * p
        p = p - jnp.sum(inverse * y[None], axis=1)
        return p / jnp.sqrt(jnp.sum(p * p, axis=0))[None]

    return jax.lax.fori_loop(0, 3, improve, start), regular


def clean(arrays: tuple[Array, ...], weights: Array) -> tuple[Array, tuple[Array, ...], Array]:
    """A mask of what can be used, and the arrays and weights (at most 1) with zeros where it cannot."""
    usable = jnp.all(weights >= 0, axis=0) & jnp.all(jnp.isfinite(weights), axis=0)
    for x in arrays:
        size = jnp.max(jnp.abs(x), axis=(0, 1))
        usable = usable & jnp.isfinite(size) & (size > floor(size) ** 2) & (size < 1.0 / floor(size) ** 2)
    largest = jnp.max(jnp.where(usable[None], weights, 0.0), axis=0)
    usable = usable & (largest > 0)
    arrays = tuple(jnp.where(usable[None, None], x, 0.0) for x in arrays)
    return usable, arrays, jnp.where(usable[None], weights / jnp.where(usable, largest, 1.0)[None], 0.0)


def _equations(p: Array, s: Array, a: Array, weights: Array, fixed: bool) -> Array:
    """Eleven equations of the least vector, for one problem."""
    if fixed:
        p = safe_divide(p, jnp.broadcast_to(p[11], p.shape))
        return gram_times(s, a, weights, p)[:11]
    p = safe_divide(p, jnp.broadcast_to(safe_sqrt(jnp.sum(p * p)), p.shape))
    y = gram_times(s, a, weights, p)
    return reflection(jax.lax.stop_gradient(p))(y - jnp.sum(p * y) * p)[1:]


def _pixel_rows(
    points: Array, pixels: Array, weights: Array, method: str
) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
    centre, factor = normalisation(points, weights)
    centre2, factor2 = normalisation(pixels, weights)
    a = homogeneous((points - centre[None]) * factor[None, None])
    rays = homogeneous((pixels - centre2[None]) * factor2[None, None])
    if method == "cross":
        rays = rays / jnp.sqrt(jnp.sum(rays * rays, axis=1))[:, None]
    return across(rays, method == "cross"), a, (centre, factor, centre2, factor2)


def _uncalibrated(method: str) -> Callable[[Data], Candidates[ProjectiveCamera]]:
    def kernel(points: Array, pixels: Array, weights: Array) -> tuple[Array, Array, Array]:
        usable, (points, pixels), weights = clean((points, pixels), weights)
        s, a, (centre, factor, centre2, factor2) = _pixel_rows(points, pixels, weights, method)
        p, regular = _least_vector(s, a, weights, method == "fix_p23")
        m = (vector3(p[0:3]), vector3(p[4:7]), vector3(p[8:11]))
        upper, rows, side, proper = rq_components(m)
        k33 = upper[5]
        k11, k12, k13, k22, k23, _ = (entry / k33 for entry in upper)
        x, y, z = (side * p[4 * i + 3] / k33 for i in range(3))
        y = (y - k23 * z) / k22
        x = (x - k12 * y - k13 * z) / k11
        # z is the depth of the centroid.
        ok = usable & regular & proper & (z > 0)
        quaternion = quaternion_from_rotation(rows)
        moved = rotate(quaternion, vector3(centre))
        pose = (*quaternion, *(c / factor - moved[i] for i, c in enumerate((x, y, z))))
        calibration = (
            *(k11 / factor2, k12 / factor2, k13 / factor2 + centre2[0]),
            *(k22 / factor2, k23 / factor2 + centre2[1], jnp.ones_like(k11)),
        )
        for c in (*pose, *calibration):
            ok = ok & jnp.isfinite(c)
        pose = jnp.stack([jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(pose)])
        identity = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
        calibration = tuple(jnp.where(ok, c, e) for c, e in zip(calibration, identity, strict=True))
        return pose[None], triangle(calibration)[None], ok[None]

    solve = lanes_last(kernel)

    def candidates(data: Data) -> Candidates[ProjectiveCamera]:
        poses, calibrations, valid = solve(*data)
        return Candidates(models=ProjectiveCamera(SE3(poses), calibrations), valid=valid)

    def equations(model: ProjectiveCamera, data: Data) -> Array:
        s, a, (centre, factor, centre2, factor2) = _pixel_rows(*data, method)
        rotation = model.cam_from_world.rotation().as_matrix()
        moved = model.cam_from_world @ centre
        extrinsic = jnp.concatenate([rotation, (moved * factor)[:, None]], axis=1)
        to_normal = jnp.stack([factor2, factor2, jnp.ones_like(factor2)])
        k = model.calibration
        k = (k - jnp.stack([centre2[0], centre2[1], jnp.zeros_like(factor2)])[:, None] * k[2][None]) * to_normal[
            :, None
        ]
        p = jnp.concatenate([jnp.sum(k[i][:, None] * extrinsic, axis=0) for i in range(3)])
        return _equations(p, s, a, data[2], method == "fix_p23")

    return implicit(candidates, equations, _perturb_projective, 11)


def _perturb_projective(model: ProjectiveCamera, tangent: Array) -> ProjectiveCamera:
    """The pose in the camera's frame, and the calibration relative to the focal lengths."""
    k = model.calibration
    zero = jnp.zeros_like(tangent[0])
    change = jnp.stack(
        [tangent[6:9] * k[0, 0], jnp.concatenate([zero[None], tangent[9:11] * k[1, 1]]), jnp.zeros_like(tangent[:3])]
    )
    return ProjectiveCamera(perturb_camera(model.cam_from_world, tangent[:6]), k + change)


_solvers = {method: _uncalibrated(method) for method in METHODS}


def dlt_pnp(
    points_world: Float[ArrayLike, "n 3"],
    pixels: Float[ArrayLike, "n 2"],
    weights: Float[ArrayLike, "n"] | None = None,
    method: str = "svd",
) -> Candidates[ProjectiveCamera]:
    """Find a camera, its calibration and its pose, from six points or more and their pixels.

    Args:
        points_world: Points in world coordinates, one per row, at least six.
        pixels: Their images, without distortion.
        weights: One non-negative weight per point, for the squares of its equations. All equal by default.
        method: What is minimised: "svd" (the usual rows, |P| = 1), "fix_p23" (the same rows, the depth of the centroid
            set to 1) or "cross" (cross products with unit rays, in normalised coordinates). Without noise they agree.

    Returns:
        One slot: `cam_from_world` in the unit of the points and the calibration matrix K in pixels, with skew. The
        minimum is algebraic; refine it where accuracy matters.

    Degenerate input: coplanar points, points on a twisted cubic with the camera, fewer than six different ones with
        positive weight, images of points behind the camera, and anything not finite leave the slot invalid; it holds
        the identity for both then. Nearly planar points pass that test, and give a calibration that is worth little.

    Differentiability: both modes, any order, in points, pixels and weights, by the implicit function theorem; zero for
        an invalid slot.

    Raises:
        ValueError: If there are fewer than six points, shapes do not match or the method is unknown.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6], [1, 1, 4], [-1, 0, 7], [0, -1, 5], [-1, 1, 5]])
        >>> pixels = 400.0 * points[:, :2] / points[:, 2:] + 300.0
        >>> camera = dlt_pnp(points, pixels).models
        >>> bool(jnp.allclose(jnp.diagonal(camera.calibration[0]), jnp.array([400.0, 400.0, 1.0]), rtol=1e-2))
        True
    """
    if method not in _solvers:
        raise ValueError(f"found method {method!r}; expected one of {', '.join(METHODS)}")
    return _solvers[method](correspondences(points_world, pixels, weights, 6))


def correspondences(points_world: ArrayLike, images: ArrayLike, weights: ArrayLike | None, least: int) -> Data:
    """Arrays of one dtype, weights filled in; refuses shapes that no solver can use."""
    points_world, images = jnp.asarray(points_world), jnp.asarray(images)
    n = points_world.shape[0]
    if images.shape[0] != n:
        raise ValueError(f"found {n} points and {images.shape[0]} images; expected as many of both")
    if n < least:
        raise ValueError(f"found {n} points; expected at least {least}")
    weights = jnp.ones(n, points_world.dtype) if weights is None else jnp.asarray(weights)
    if weights.shape != (n,):
        raise ValueError(f"found weights of shape {weights.shape}; expected one per point, {(n,)}")
    dtype = jnp.result_type(points_world, images, weights)
    return points_world.astype(dtype), images.astype(dtype), weights.astype(dtype)


class _LinearPose(NamedTuple):
    """The pose, and the unit vector of the entries of P in normalised coordinates that it comes from."""

    cam_from_world: SE3
    entries: Array


def _bearing_rows(points: Array, bearings: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
    centre, factor = normalisation(points, weights)
    length = safe_sqrt(jnp.sum(bearings * bearings, axis=1))
    rays = safe_divide(bearings, jnp.broadcast_to(length[:, None], bearings.shape))
    return across(rays, True), homogeneous((points - centre[None]) * factor[None, None]), centre, factor


def _calibrated_kernel(points: Array, bearings: Array, weights: Array) -> tuple[Array, Array, Array]:
    usable, (points, bearings), weights = clean((points, bearings), weights)
    usable = usable & jnp.all((weights == 0) | jnp.any(bearings != 0, axis=1), axis=0)
    s, a, centre, factor = _bearing_rows(points, bearings, weights)
    p, regular = _least_vector(s, a, weights, False)
    m = (vector3(p[0:3]), vector3(p[4:7]), vector3(p[8:11]))
    # The sign of P is free: the one that makes a rotation, and then the points must be in front.
    side = sign(dot3(m[0], cross3(m[1], m[2])))
    p = side[None] * p
    u, singular, v = svd3(tuple(tuple(side * entry for entry in row) for row in m))
    rotation = tuple(
        tuple(u[0][i] * v[0][j] + u[1][i] * v[1][j] + u[2][i] * v[2][j] for j in range(3)) for i in range(3)
    )
    scale = (singular[0] + singular[1] + singular[2]) / 3.0
    eps = float(jnp.finfo(p.dtype).eps)
    # Singular to rounding: all points but one in a plane through the camera, say.
    ok = usable & regular & (singular[2] > 64.0 * eps * singular[0])
    scale = jnp.where(ok, scale, 1.0)
    y = jnp.stack([jnp.sum(p[4 * r : 4 * r + 4][None] * a, axis=1) for r in range(3)], axis=1)
    ok = ok & (jnp.sum(weights[:, None] * y * bearings, axis=(0, 1)) > 0)
    quaternion = quaternion_from_rotation(rotation)
    moved = rotate(quaternion, vector3(centre))
    pose = (*quaternion, *(p[4 * i + 3] / (scale * factor) - moved[i] for i in range(3)))
    for c in pose:
        ok = ok & jnp.isfinite(c)
    pose = jnp.stack([jnp.where(ok, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(pose)])
    return pose[None], jnp.where(ok[None], p, 0.0)[None], ok[None]


_calibrated_solve = lanes_last(_calibrated_kernel)


def _calibrated_candidates(data: Data) -> Candidates[_LinearPose]:
    poses, entries, valid = _calibrated_solve(*data)
    return Candidates(models=_LinearPose(SE3(poses), entries), valid=valid)


def _calibrated_equations(model: _LinearPose, data: Data) -> Array:
    """Eleven for the entries of P, three for its rotation (Rᵀ M symmetric), three for its translation."""
    s, a, centre, factor = _bearing_rows(*data)
    p = model.entries.reshape(3, 4)
    rotation = model.cam_from_world.rotation().as_matrix()
    stretch = jnp.sum(rotation[:, :, None] * p[:, None, :3], axis=0)
    scale = (stretch[0, 0] + stretch[1, 1] + stretch[2, 2]) / 3.0
    twist = stretch - stretch.T
    shift = p[:, 3] - scale * factor * (model.cam_from_world @ centre)
    turn = jnp.stack([twist[0, 1], twist[0, 2], twist[1, 2]])
    return jnp.concatenate([_equations(model.entries, s, a, data[2], False), turn, shift])


def _perturb_linear(model: _LinearPose, tangent: Array) -> _LinearPose:
    reflect = reflection(jax.lax.stop_gradient(model.entries))
    step = reflect(jnp.concatenate([jnp.zeros_like(tangent[:1]), tangent[6:]]))
    return _LinearPose(perturb_camera(model.cam_from_world, tangent[:6]), model.entries + step)


_calibrated = implicit(_calibrated_candidates, _calibrated_equations, _perturb_linear, 17)


def dlt_pnp_calibrated(
    points_world: Float[ArrayLike, "n 3"],
    bearings: Float[ArrayLike, "n 3"],
    weights: Float[ArrayLike, "n"] | None = None,
) -> Candidates[SE3]:
    """Find the pose of a calibrated camera from six points or more by linear equations.

    Minimises Σ w |f x (A X + b)|² with twelve free entries of (A, b), that is sin² of the angles times squared
    distances; then takes the rotation nearest to A, and b at A's mean scale. With noise A is no multiple of a rotation:
    the pose fits the bearings worse than `epnp`, and needs refinement.

    Args:
        points_world: Points in world coordinates, one per row, at least six.
        bearings: Directions towards them in the camera's frame, of any positive length and in any direction.
        weights: One non-negative weight per point, for the squares of its equations. All equal by default.

    Returns:
        One slot with `cam_from_world` in the unit of the points.

    Degenerate input: coplanar points, points on a twisted cubic with the camera, fewer than six different ones with
        positive weight, bearings that are zero, mirrored or point away from the points, and anything not finite leave
        the slot invalid, with the identity in it.

    Differentiability: both modes, any order, in points, bearings and weights, by the implicit function theorem; zero
        for an invalid slot.

    Raises:
        ValueError: If there are fewer than six points or shapes do not match.
    References: see the module.

    Example:
        >>> points = jnp.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6], [1, 1, 4], [-1, 0, 7], [0, -1, 5], [-1, 1, 5]])
        >>> candidates = dlt_pnp_calibrated(points, points)
        >>> bool(jnp.abs(candidates.models.translation()).max() < 1e-3)
        True
    """
    found = _calibrated(correspondences(points_world, bearings, weights, 6))
    return Candidates(models=found.models.cam_from_world, valid=found.valid)
