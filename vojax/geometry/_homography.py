"""Motions that a plane's homography allows, and their metric scale from a known height.

A plane nᵀX = d seen by both cameras moves its points by X1 = R X0 + t, so that in normalized coordinates

    H ~ R + (t / d) nᵀ.                                                                                       (1)

Scaled to middle singular value one and positive determinant, H keeps the length of all vectors across n, since on them
it equals R. The vectors whose length it keeps form two planes, both through its middle right singular vector v2: with
singular values σ1 >= 1 >= σ3 they are spanned by v2 and

    u± = (√(1 - σ3²) v1 ± √(σ1² - 1) v3) / √(σ1² - σ3²).                                                       (2)

R follows from what H does to v2 and u, and the sign of n is open: two times two motions. The singular vectors come from
Jacobi rotations of H itself: from HᵀH - I, or from the characteristic cubic, whose roots merge where the translation is
along the normal, half of the digits would be lost there. None of it is differentiated: (1) is, in closed form.

References:
    O. Faugeras, F. Lustman. Motion and structure from motion in a piecewise planar environment. IJPRAI 1988.
    Y. Ma, S. Soatto, J. Košecká, S. Sastry. An invitation to 3-D vision, section 5.3.3.
    E. Malis, M. Vargas. Deeper understanding of the homography decomposition for vision-based control. INRIA 2007.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import normalize, safe_divide, safe_norm
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3, SO3

from ._null_vector import _jacobi

MotionParts = tuple[Array, Array, Array, Array, Array]


class HomographyMotion(eqx.Module):
    """The motions a homography allows: four slots, of which some are possible.

    Attributes:
        cam1_from_cam0: Poses; the translation is in units of the plane's distance from camera 0, t / d.
        normal: Unit normals in camera 0, pointing away from it: visible points have normalᵀ ray > 0. Zero where it is
            undefined (`is_rotation`) and in slots that are not valid.
        valid: True for the possible ones. The others hold the identity.
        is_rotation: True if H is a rotation to rounding: slot 0 holds it, with translation and normal zero.
    """

    cam1_from_cam0: SE3
    normal: Float[Array, "*batch 4 3"]
    valid: Bool[Array, "*batch 4"]
    is_rotation: Bool[Array, "*batch"]


def decompose_homography(
    homography: Float[ArrayLike, "3 3"],
    rays0: Float[ArrayLike, "n 3"] | None = None,
    mask: Bool[ArrayLike, "n"] | None = None,
) -> HomographyMotion:
    """Find the camera motions and plane normals that give a homography.

    Args:
        homography: H in normalized coordinates, from camera 0 to camera 1, of any scale and sign: K1⁻¹ H K0 of one in
            pixels. Both cameras are taken to be on the same side of the plane.
        rays0: Directions in camera 0 of points on the plane, of any length. Motions that put one of them behind the
            camera are dropped: two at most remain, and one where the rays fill a wide field of view. Without, all four
            are kept: slots 0 and 1, and 2 and 3, are the same up to the signs of translation and normal.
        mask: Which rays to use, all by default. Outliers must be out.

    Returns:
        The motions in fixed slots.

    Degenerate input: a pure rotation has slot 0 alone, without a normal. A translation along the normal is one motion,
        up to sign, found to the square root of the precision; its slots 2 and 3 are not valid. A singular matrix
        (camera 1 in the plane) and anything not finite have no valid slot.

    Differentiability: both modes, any order: the derivative of (1) inverted in closed form. Zero for slots that are not
        valid, for a rotation, and for translations along the normal, where the solution has none.

    References: see the module.

    Example:
        >>> import jax.numpy as jnp
        >>> ahead = jnp.eye(3).at[2, 1].add(-0.1)  # a tenth of the camera's height over the ground
        >>> motion = decompose_homography(ahead, rays0=jnp.array([[0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.1, 1.0]]))
        >>> int(motion.valid.sum())
        2
        >>> errors = jnp.abs(motion.normal - jnp.array([[0.0, 1.0, 0.0]])).max(axis=1)
        >>> bool(jnp.any(motion.valid & (errors < 1e-5)))
        True
    """
    homography = jnp.asarray(homography)
    wxyz, translation, normal, valid, is_rotation = _motions(homography)
    if rays0 is not None:
        heights = jnp.sum(normal[:, None] * jnp.asarray(rays0)[None], axis=-1)
        behind = heights <= 0 if mask is None else (heights <= 0) & jnp.asarray(mask)[None]
        seen = valid & (is_rotation | ~jnp.any(behind, axis=1))
        identity = jnp.eye(4, dtype=wxyz.dtype)[0]
        wxyz = jnp.where(seen[:, None], wxyz, identity[None])
        translation, normal = (jnp.where(seen[:, None], x, 0.0) for x in (translation, normal))
        valid = seen
    pose = SE3(jnp.concatenate([wxyz, translation], axis=1))
    return HomographyMotion(cam1_from_cam0=pose, normal=normal, valid=valid, is_rotation=is_rotation)


@jax.custom_jvp
def _motions(homography: Float[Array, "3 3"]) -> MotionParts:
    """Quaternions [4, 4], translations [4, 3], normals [4, 3], validity [4], and whether H is a rotation."""
    eps = float(jnp.finfo(homography.dtype).eps)
    finite = jnp.all(jnp.isfinite(homography))
    largest = jnp.max(jnp.abs(jnp.where(finite, homography, 0.0)))
    proper = largest > 0
    h = jnp.where(
        proper, jnp.where(finite, homography, 0.0) / jnp.where(proper, largest, 1.0), jnp.eye(3, dtype=homography.dtype)
    )
    vectors, squares = _jacobi(h)
    order = jnp.argsort(-squares)
    (v1, v2, v3), (first, middle, last) = vectors[order], squares[order]
    proper = proper & (last > (16.0 * eps) ** 2 * first)
    middle = jnp.where(proper, middle, 1.0)
    h = h * _sign(jnp.dot(h[0], jnp.cross(h[1], h[2]))) / jnp.sqrt(middle)

    shrinks = jnp.maximum(1.0 - last / middle, 0.0)
    grows = jnp.maximum(first / middle - 1.0, 0.0)
    is_rotation = proper & (shrinks + grows < 64.0 * eps)
    # Both planes are one if a side of (2) is rounding: the translation is along the normal.
    distinct = jnp.minimum(shrinks, grows) > 16.0 * eps
    shrinks, grows = (jnp.where(~distinct & (x < y), 0.0, x) for x, y in ((shrinks, grows), (grows, shrinks)))
    a, b = jnp.sqrt(shrinks)[None], jnp.sqrt(grows)[None]
    moves = shrinks + grows > 0

    wxyz, translation, normal = [], [], []
    for sign in (1.0, -1.0):
        u = normalize(jnp.where(moves, a * v1 + sign * b * v3, v1))
        n = jnp.cross(v2, u)
        moved2, moved = normalize(h @ v2), normalize(h @ u)
        frame = jnp.stack([v2, u, n])
        image = jnp.stack([moved2, moved, jnp.cross(moved2, moved)])
        rotation = jnp.sum(image[:, :, None] * frame[:, None, :], axis=0)
        t = jnp.where(is_rotation, 0.0, (h - rotation) @ n)
        n = jnp.where(is_rotation, 0.0, n)
        wxyz += [SO3.from_matrix(rotation).wxyz] * 2
        translation += [t, -t]
        normal += [n, -n]
    slot = jnp.arange(4)
    valid = proper & ((slot < 2) | distinct) & ((slot < 1) | ~is_rotation)
    identity = jnp.eye(4, dtype=h.dtype)[0]
    return (
        jnp.where(valid[:, None], jnp.stack(wxyz), identity[None]),
        jnp.where(valid[:, None], jnp.stack(translation), 0.0),
        jnp.where(valid[:, None], jnp.stack(normal), 0.0),
        valid,
        is_rotation,
    )


def _sign(x: Array) -> Array:
    return jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)


@_motions.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """Derivative of s H = R + t nᵀ solved for the changes of R, t, n and s."""
    (h,), (dh,) = primals, tangents
    parts = _motions(h)
    wxyz, translation, normal, valid, is_rotation = parts
    # Slots 2 and 3 are valid exactly where the motion is differentiable.
    smooth = valid & valid[2]

    def slot(wxyz: Array, t: Array, n: Array, smooth: Array) -> tuple[Array, Array, Array]:
        rotation = SO3(wxyz).as_matrix()
        n = jnp.where(smooth, n, jnp.eye(3, dtype=n.dtype)[2])
        t = jnp.where(smooth, t, jnp.eye(3, dtype=t.dtype)[0])
        model = rotation + t[:, None] * n[None]
        # The scale of H by its size first: its square may be no number.
        size = jnp.max(jnp.abs(jnp.where(smooth, h, model)))
        unit = jnp.where(smooth, h, model) / size
        scale = jnp.sum(model * unit) / jnp.sum(unit * unit)
        change = rotation.T @ (jnp.where(smooth, dh, 0.0) / size * scale)
        # Rᵀ dH = κ (I + c nᵀ) + [φ]× + a nᵀ + c bᵀ with c = Rᵀt, φ and a = Rᵀdt in the frame of camera 0, and b = dn
        # across n. In a frame (e1, e2, n) the first two columns give κ, φ and b, the last one a.
        c = rotation.T @ t
        e1, e2 = _across(n)
        frame = jnp.stack([e1, e2, n])
        m = frame @ change @ frame.T
        c = frame @ c
        across2 = c[0] * c[0] + c[1] * c[1]
        shear, stretch = m[0, 1] + m[1, 0], m[0, 0] - m[1, 1]
        b1 = safe_divide(c[1] * shear + c[0] * stretch, across2)
        b2 = safe_divide(c[0] * shear - c[1] * stretch, across2)
        kappa = m[0, 0] - c[0] * b1
        phi = jnp.stack([m[2, 1] - c[2] * b2, c[2] * b1 - m[2, 0], m[1, 0] - c[1] * b1])
        a = m[:, 2] - kappa * c - jnp.stack([phi[1], -phi[0], kappa])
        phi, a = frame.T @ phi, frame.T @ a
        w, axis = wxyz[0], wxyz[1:]
        turn = 0.5 * jnp.concatenate([-jnp.dot(axis, phi)[None], w * phi + jnp.cross(axis, phi)])
        return tuple(jnp.where(smooth, x, 0.0) for x in (turn, rotation @ a, b1 * e1 + b2 * e2))  # type: ignore[return-value]

    changes = jax.vmap(slot)(wxyz, translation, normal, smooth)
    none = tuple(np.zeros(x.shape, jax.dtypes.float0) for x in (valid, is_rotation))
    return parts, (*changes, *none)


def _across(n: Float[Array, "3"]) -> tuple[Array, Array]:
    """Two unit vectors that complete n to a right-handed frame (e1, e2, n) (Duff et al., 2017)."""
    x, y, z = n[0], n[1], n[2]
    s = _sign(z)
    p = -1.0 / (s + z)
    xy = x * y * p
    return jnp.stack([1.0 + s * x * x * p, s * xy, -s * x]), jnp.stack([xy, s + y * y * p, -y])


def metric_translation(
    motion: HomographyMotion,
    height: Float[ArrayLike, ""] | float,
    down: Float[ArrayLike, "3"] | None = None,
    max_angle: float = 0.35,
) -> HomographyMotion:
    """Give the motions over a ground plane their metric scale, from the camera's height over it.

    Args:
        motion: Motions of `decompose_homography` for the ground plane.
        height: Distance of camera 0 from the ground, along its normal, in metres.
        down: Expected direction of the ground in camera 0, straight down, of any length; (0, 1, 0), a level camera, by
            default.
        max_angle: Motions whose normal is further from `down`, in radians, are not of the ground and become invalid.

    Returns:
        The motions with translations in metres. A pure rotation has no normal and stays as it is.

    Degenerate input: a height that is negative or not finite, or a zero `down`, leaves no slot valid.

    Differentiability: both modes, in the motion and the height; the choice by angle has no derivative.

    References: Scaramuzza & Fraundorfer, "Visual Odometry Part I", 2011 (motion from the ground plane).

    Example:
        >>> import jax.numpy as jnp
        >>> ahead = jnp.eye(3).at[2, 1].add(-0.1)
        >>> motion = metric_translation(decompose_homography(ahead), height=1.5)
        >>> int(motion.valid.sum())
        1
        >>> translation = motion.cam1_from_cam0.translation()[jnp.argmax(motion.valid)]
        >>> bool(jnp.allclose(translation, jnp.array([0.0, 0.0, -0.15]), atol=1e-5))
        True
    """
    parameters = motion.cam1_from_cam0.parameters()
    dtype = parameters.dtype
    height = jnp.asarray(height, dtype)
    down = jnp.asarray([0.0, 1.0, 0.0] if down is None else down, dtype)
    usable = jnp.isfinite(height) & (height > 0) & jnp.all(jnp.isfinite(down)) & (safe_norm(down) > 0)
    height = jnp.where(usable, height, 0.0)
    held = jax.lax.stop_gradient(motion.normal)
    cosine = jnp.sum(held * normalize(jnp.where(usable, down, 0.0))[None], axis=-1)
    # An angle of π and more takes every normal.
    least = jnp.cos(jnp.clip(jnp.asarray(max_angle, dtype), 0.0, jnp.pi)) - 4.0 * float(jnp.finfo(dtype).eps)
    valid = motion.valid & usable & (motion.is_rotation | (cosine >= least))
    metric = jnp.concatenate([parameters[:, :4], parameters[:, 4:] * height], axis=1)
    identity = jnp.eye(7, dtype=dtype)[0]
    return HomographyMotion(
        cam1_from_cam0=SE3(jnp.where(valid[:, None], metric, identity[None])),
        normal=jnp.where(valid[:, None], motion.normal, 0.0),
        valid=valid,
        is_rotation=motion.is_rotation,
    )
