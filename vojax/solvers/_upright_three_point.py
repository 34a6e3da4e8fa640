"""Relative pose from three points and the vertical: three epipolar equations, up to four poses.

With the vertical known in both cameras, R turns by one angle θ about it and t has two degrees of freedom:

    t . (R f_i x g_i) = 0,     R u0 = u1,     |t| = 1,     i = 0, 1, 2.                                            (1)

Take axes with y along the vertical in both views and write the horizontal parts of the bearings as complex numbers,
f = f_x + i f_z and g = g_x + i g_z, and w = exp(-iθ/2) = p - iq. Seen from the frame halfway between the two cameras,
f turned by w and g by its conjugate, the components of the normal R f x g are

    n_z - i n_x = p (g_y f - f_y g) - iq (g_y f + f_y g),      n_y = (p² - q²) Im(f ḡ) - 2 p q Re(f ḡ).            (2)

So the determinant of three normals is a quartic in tan(θ/2) = q / p as it stands, without a common factor to divide by,
and a half turn (p = 0) is an ordinary root. t is the null vector of the normals, in the half-way frame.

Points far away are the common case and ill-conditioned as written: three roots draw together at the rotation that
aligns the bearings. Hence f is turned first by the angle that aligns it best with g. What then remains of the vectors
g_y f - f_y g and of Im(f ḡ) is the parallax σ, and in q / (σ p) the roots are apart again: the error is eps / σ, not
its cube root.

Precondition: three distinct points, not all at the height of the cameras, and a motion that is not a pure rotation.

References:
    F. Fraundorfer, P. Tanskanen, M. Pollefeys. A minimal case solution to the calibrated relative pose problem for the
        case of two known orientation angles. ECCV 2010.
    C. Sweeney, J. Flynn, M. Turk. Solving for relative pose with a partially known rotation is a quadratic eigenvalue
        problem. 3DV 2014.
"""

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import Vector3, cross3, dot3, lane_sum, normalize
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, complement, floor, quaternion_from_rotation, squared, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last, one_kernel
from ._roots import quartic_roots

UP = np.array([0.0, -1.0, 0.0])

# The rounding of bearings after turning and aligning them, in eps: less parallax than this is none.
NO_PARALLAX = 16.0
# What the determinant may round to, in eps of what its terms add up to; an unfinished root is off by far more.
ROOT = 64.0


def unit_components(x: Vector3) -> tuple[Vector3, Bool[Array, "*shape"]]:
    """Vectors of length one, and which could be made so; the others come back as zero."""
    size = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])), jnp.abs(x[2])))
    limit = floor(size) ** 2
    proper = (size > limit) & (size < 1.0 / limit)
    x = tuple(jnp.where(proper, c / jnp.where(proper, size, 1.0), 0.0) for c in x)
    norm = jnp.sqrt(jnp.where(proper, squared(x), 1.0))
    return tuple(c / norm for c in x), proper


def upright_frame(up: Float[Array, "3 *lanes"]) -> tuple[Rows3, Bool[Array, "*lanes"]]:
    """Axes x, y, z of a frame whose y axis points down."""
    (x, y, z), proper = unit_components(vector3(up))
    down = (-x, -y, -z)
    ahead, right = complement(down)
    return (right, down, ahead), proper


def upright_bearings(rays: Float[Array, "n 3 *lanes"], axes: Rows3) -> tuple[Vector3, Bool[Array, "*lanes"]]:
    """Unit bearings in the frame `axes`, components [n, *lanes], and whether all of them are proper."""
    unit, proper = unit_components((rays[:, 0], rays[:, 1], rays[:, 2]))
    bearings = tuple(dot3(tuple(c[None] for c in axis), unit) for axis in axes)
    return bearings, jnp.all(proper, axis=0)


def align_horizontally(f: Vector3, g: Vector3) -> tuple[Vector3, tuple[Array, Array]]:
    """Turn f about y by the angle that aligns it best with g; also the angle's cosine and sine."""
    cosine = lane_sum(f[0] * g[0] + f[2] * g[2], axis=0)
    sine = lane_sum(f[2] * g[0] - f[0] * g[2], axis=0)
    size = jnp.sqrt(cosine * cosine + sine * sine)
    usable = size > floor(size)
    cosine = jnp.where(usable, cosine / jnp.where(usable, size, 1.0), 1.0)
    sine = jnp.where(usable, sine / jnp.where(usable, size, 1.0), 0.0)
    return turn(cosine[None], sine[None], f), (cosine, sine)


def turn(cosine: Array, sine: Array, x: Vector3) -> Vector3:
    """Turn vectors about y, z towards x."""
    return (cosine * x[0] + sine * x[2], x[1], cosine * x[2] - sine * x[0])


def pose_components(axes0: Rows3, axes1: Rows3, angle: tuple[Array, Array], t: Vector3) -> Components:
    """Pose [s, *lanes] in the cameras' frames from cosine and sine of the turn about y, and t in upright frame 1."""
    right, down, ahead = (tuple(c[None] for c in axis) for axis in axes0)
    turned = (
        tuple(angle[0] * x + angle[1] * z for x, z in zip(right, ahead, strict=True)),
        down,
        tuple(angle[0] * z - angle[1] * x for x, z in zip(right, ahead, strict=True)),
    )
    back = tuple(tuple(c[None] for c in axis) for axis in axes1)
    rotation = tuple(tuple(sum(back[k][i] * turned[k][j] for k in range(3)) for j in range(3)) for i in range(3))
    return (
        *quaternion_from_rotation(rotation),  # type: ignore[arg-type]
        *(back[0][i] * t[0] + back[1][i] * t[1] + back[2][i] * t[2] for i in range(3)),
    )


def angle_error(rounding: Array, slope: Array) -> Array:
    """Rounding of the angle θ at a root: that of the polynomial over its slope, half the digits at a double root."""
    eps = float(jnp.finfo(slope.dtype).eps)
    return jnp.minimum(2.0 * rounding / jnp.maximum(jnp.abs(slope), eps), eps**0.5)


def choose_sign(f: Vector3, g: Vector3, normal: Vector3, t: Vector3, blur: Array) -> tuple[Array, Array]:
    """The sign of t [s, *lanes] that puts all points [n, s, *lanes] in front of both cameras, and whether one does.

    With n = f x g the distances are -(t x g) . n / |n|² and -(t x f) . n / |n|². Bearings that agree to rounding and
    the error `blur` of the angle belong to a point at infinity, which is in front; opposite ones to a point between the
    cameras.
    """
    lanes = tuple(c[None] for c in t)
    limit = NO_PARALLAX * float(jnp.finfo(t[0].dtype).eps) + blur
    far = squared(normal) <= (limit * limit)[None]
    along = dot3(lanes, g)
    agree = dot3(f, g) > 0
    distance0, distance1 = -dot3(cross3(lanes, g), normal), -dot3(cross3(lanes, f), normal)
    positive = jnp.where(far, agree | (along > 0.99), (distance0 > 0) & (distance1 > 0))
    negative = jnp.where(far, agree | (along < -0.99), (distance0 < 0) & (distance1 < 0))
    positive, negative = jnp.all(positive, axis=0), jnp.all(negative, axis=0)
    return jnp.where(positive, 1.0, -1.0).astype(t[0].dtype), positive | negative


def placeholders(model: Components, valid: Array) -> tuple[Array, Array]:
    """Poses [s, 7, *lanes], the identity where a slot is not valid or not finite."""
    for c in model:
        valid = valid & jnp.isfinite(c)
    return jnp.stack([jnp.where(valid, c, 1.0 if i == 0 else 0.0) for i, c in enumerate(model)], axis=1), valid


def _product(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Coefficients of (a0 + a1 x)(b0 + b1 x)."""
    return a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1]


def _kernel(rays0: Array, rays1: Array, up0: Array, up1: Array) -> tuple[Array, Array]:
    """Poses [4, 7, *lanes] and validity [4, *lanes]."""
    eps = float(jnp.finfo(rays0.dtype).eps)
    axes0, proper0 = upright_frame(up0)
    axes1, proper1 = upright_frame(up1)
    f, finite0 = upright_bearings(rays0, axes0)
    g, finite1 = upright_bearings(rays1, axes1)
    proper = proper0 & proper1 & finite0 & finite1
    f, (cosine, sine) = align_horizontally(f, g)

    # (2), from differences: D = g_y f - f_y g = (a, c), S = g_y f + f_y g = (d, b), f ḡ = r + i m.
    gap = tuple(f[i] - g[i] for i in range(3))
    a, c = g[1] * gap[0] - gap[1] * g[0], g[1] * gap[2] - gap[1] * g[2]
    d, b = g[1] * f[0] + f[1] * g[0], g[1] * f[2] + f[1] * g[2]
    m, r = gap[2] * g[0] - gap[0] * g[2], f[0] * g[0] + f[2] * g[2]
    sigma = jnp.max(jnp.maximum(jnp.maximum(jnp.abs(a), jnp.abs(c)), jnp.abs(m)), axis=0)
    proper = proper & (sigma > NO_PARALLAX * eps)
    sigma = jnp.where(proper, sigma, 1.0)
    a, c, m = a / sigma[None], c / sigma[None], m / sigma[None]

    # The determinant in y = q / (σ p), and its rounding over eps / σ: every factor of a term is off by that much.
    coefficients = [jnp.zeros_like(sigma)] * 5
    scale = jnp.zeros_like(sigma)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        plus, minus = _product((a[j], b[j]), (c[k], -d[k])), _product((a[k], b[k]), (c[j], -d[j]))
        minor = tuple(x - y for x, y in zip(plus, minus, strict=True))
        row = (m[i], -2.0 * r[i], -m[i] * sigma * sigma)
        for x, entry in enumerate(row):
            for y, other in enumerate(minor):
                coefficients[x + y] = coefficients[x + y] + entry * other
        size = [jnp.abs(a[n]) + jnp.abs(b[n]) + jnp.abs(c[n]) + jnp.abs(d[n]) for n in (j, k)]
        scale = scale + size[0] * size[1] + (jnp.abs(m[i]) + jnp.abs(r[i])) * (size[0] + size[1])
    quartic = jnp.stack(coefficients)
    proper = proper & (jnp.max(jnp.abs(quartic), axis=0) > 2.0 * eps * scale / sigma)
    (u, v), valid = quartic_roots(quartic)

    s = sigma[None]

    def rows(p: Array, y: Array) -> Vector3:
        """Normals over σ, components [3, 4, *lanes]."""
        p, y, q = p[None], y[None], (s * y)[None]
        level = p * c[:, None] - y * d[:, None]
        upright = (p * p - q * q) * m[:, None] - 2.0 * p * y * r[:, None]
        return (-level, upright, p * a[:, None] + y * b[:, None])

    def slopes(p: Array, y: Array) -> Vector3:
        """Their derivatives when p moves by -σ² y and y by p, a turn."""
        p, y, q = p[None], y[None], (s * y)[None]
        faster = s[None] * s[None] * y
        level = -faster * c[:, None] - p * d[:, None]
        upright = -4.0 * p * q * s[None] * m[:, None] - 2.0 * (p * p - q * q) * r[:, None]
        return (-level, upright, -faster * a[:, None] + p * b[:, None])

    def minors(normal: Vector3) -> list[Vector3]:
        """Cross products of the normals 1 x 2, 2 x 0 and 0 x 1."""
        n = [tuple(x[i] for x in normal) for i in range(3)]
        return [cross3(n[(i + 1) % 3], n[(i + 2) % 3]) for i in range(3)]

    def unit(p: Array, y: Array) -> tuple[Array, Array]:
        length = jnp.sqrt(p * p + s * s * y * y)
        return p / length, y / length

    def newton(_: object, root: tuple[Array, Array]) -> tuple[Array, Array]:
        """On the determinant itself, which rounds less than its coefficients."""
        p, y = root
        normal, crosses, change = rows(p, y), minors(rows(p, y)), slopes(p, y)
        parts = [sum(change[k][i] * crosses[i][k] for k in range(3)) for i in range(3)]
        slope = parts[0] + parts[1] + parts[2]
        usable = jnp.abs(slope) > eps**0.5 * (jnp.abs(parts[0]) + jnp.abs(parts[1]) + jnp.abs(parts[2]))
        value = sum(normal[k][0] * crosses[0][k] for k in range(3))
        limit = 0.1 * (1.0 + jnp.abs(y))
        step = jnp.where(usable, jnp.clip(value / jnp.where(usable, slope, 1.0), -limit, limit), 0.0)
        return unit(p + s * s * y * step, y - p * step)

    p, y = jax.lax.fori_loop(0, 6, newton, unit(v, u))
    q = s * y
    change = slopes(p, y)
    normal = rows(p, y)
    crosses = minors(normal)
    slope = sum(change[k][i] * crosses[i][k] for k in range(3) for i in range(3))
    blur = angle_error((2.0 * eps * scale)[None], slope)  # type: ignore[arg-type]
    # A root that two have run into counts once.
    for later in range(1, 4):
        gap = jnp.abs(p[later][None] * y[:later] - y[later][None] * p[:later])
        met = jnp.any(valid[:later] & (gap < 0.5 * eps**0.5), axis=0)
        valid = valid.at[later].set(valid[later] & ~met)

    squares = [squared(x) for x in crosses]
    second = squares[1] > squares[0]
    largest = jnp.maximum(squares[0], squares[1])
    third = squares[2] > largest
    t = tuple(jnp.where(third, z, jnp.where(second, y, x)) for x, y, z in zip(*crosses, strict=True))
    length = jnp.sqrt(jnp.maximum(jnp.maximum(largest, squares[2]), floor(largest) ** 3))
    t = tuple(x / length for x in t)
    # Two of three equations hold by construction, the third if the root is one.
    longest = jnp.sqrt(jnp.max(squared(normal), axis=0))
    value = sum(normal[k][0] * crosses[0][k] for k in range(3))
    valid = valid & (jnp.abs(value) <= ROOT * eps * longest * longest * longest / s)
    valid = valid & proper[None] & (s * length > NO_PARALLAX * eps * longest)
    ahead, behind = (
        turn(x, z, ray)
        for x, z, ray in (
            (p[None], q[None], tuple(x[:, None] for x in f)),
            (p[None], -q[None], tuple(x[:, None] for x in g)),
        )
    )
    sense, in_front = choose_sign(ahead, behind, tuple(s[None] * x for x in normal), t, blur)
    valid = valid & in_front
    # Out of the half-way frame.
    t = turn(p, q, tuple(sense * x for x in t))
    c2, s2 = p * p - q * q, 2.0 * p * q
    angle = (c2 * cosine[None] - s2 * sine[None], c2 * sine[None] + s2 * cosine[None])
    return placeholders(pose_components(axes0, axes1, angle, t), valid)


_solve = lanes_last(one_kernel(_kernel), chunk=128)

Data = tuple[Array, Array, Array, Array]


def upright_motion(cam1_from_cam0: SE3, data: Data) -> tuple[Array, Array, Array, Array]:
    """The residuals of (1): epipolar equations [n], R u0 - u1 across u1 [2], |t|² - 1; and u1.

    Directions are scaled by their largest component, held fixed, so that their squares are ordinary numbers.
    """

    def unit(x: Array) -> Array:
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True))
        return normalize(x / jnp.where(size > 0, size, 1.0))

    f, g, up0, up1 = (unit(x) for x in data)
    rotation, t = cam1_from_cam0.rotation(), cam1_from_cam0.translation()
    epipolar = jnp.sum(jnp.cross(rotation @ f, g) * t[None, :], axis=-1)
    held = jax.lax.stop_gradient(up1)
    tilt = rotation @ up0 - up1
    across = jnp.stack([jnp.sum(jnp.stack(axis) * tilt) for axis in complement((held[0], held[1], held[2]))])
    return epipolar, across, (jnp.sum(t * t) - 1.0)[None], up1


def _equations(cam1_from_cam0: SE3, data: Data) -> Array:
    epipolar, across, length, _ = upright_motion(cam1_from_cam0, data)
    return jnp.concatenate([epipolar, across, length])


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


_upright_three_point = implicit(_candidates, _equations, perturb_camera, 6)


def arrays(expected: tuple[int, ...], rays: tuple[ArrayLike, ...], directions: tuple[ArrayLike, ...]) -> Data:
    """Rays and directions of one dtype, that of the rays; refuses other shapes."""
    rays = tuple(jnp.asarray(x) for x in rays)
    for x in rays:
        if x.shape != expected:
            raise ValueError(f"found rays of shape {x.shape}; expected {expected} in both cameras: vmap over batches")
    directions = tuple(jnp.asarray(x) for x in directions)
    for x in directions:
        if x.shape != (3,):
            raise ValueError(f"found a direction of shape {x.shape}; expected (3,) in the frame of the camera")
    dtype = jnp.result_type(*rays)
    return tuple(x.astype(dtype) for x in (*rays, *directions))  # type: ignore[return-value]


def upright_three_point(
    rays0: Float[ArrayLike, "3 3"],
    rays1: Float[ArrayLike, "3 3"],
    up0: Float[ArrayLike, "3"] = UP,
    up1: Float[ArrayLike, "3"] = UP,
) -> Candidates[SE3]:
    """Find the relative poses of two cameras with known vertical from three correspondences.

    The vertical comes from an inertial sensor, a vanishing point or, by default, from a camera that is mounted level.
    For a batch, `jax.vmap(upright_three_point, in_axes=(-1, -1, ...), out_axes=-1)` is the fast layout on a CPU.

    Args:
        rays0: Directions to the points in camera 0's frame, one per row, of any positive length.
        rays1: Directions to the same points in camera 1's frame.
        up0: The vertical in camera 0's frame, up or down, of any length; by default the camera's -y axis.
        up1: The same direction in camera 1's frame.

    Returns:
        Four slots of `cam1_from_cam0` with |t| = 1. Valid slots take `up0` to `up1`, satisfy the epipolar equations and
        have all points in front, at positive distances along their rays (which of ±t does so is chosen; where neither
        does, the slot is not valid). The others hold the identity.

    Degenerate input: no slot is valid if a rotation about the vertical explains the rays to rounding (no parallax), if
        two correspondences are the same, if all points are at the height of both cameras or one is straight above or
        below both, for zero rays or verticals and anything not finite. Points at infinity are allowed, one of three.
    Differentiability: both modes, any order, in all arguments, by the implicit function theorem; zero for slots that
        are not valid and at double roots.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.

    Example:
        >>> rays0 = jnp.array([[0.0, 0.5, 1.0], [0.3, -0.2, 1.0], [-0.4, 0.1, 1.0]])
        >>> depths = jnp.array([[4.0], [5.0], [6.0]])
        >>> candidates = upright_three_point(rays0, rays0 * depths - jnp.array([[0.0, 0.0, 1.0]]))
        >>> errors = jnp.abs(candidates.models.translation() - jnp.array([[0.0, 0.0, -1.0]])).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    return _upright_three_point(arrays((3, 3), (rays0, rays1), (up0, up1)))
