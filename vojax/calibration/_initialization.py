"""Where a calibration starts: planar homographies, Zhang's closed form, and a sweep over focal lengths.

A plane z = 0 is seen through H ~ K [r1 r2 t]. From r1·r2 = 0 and |r1| = |r2| every view gives two equations linear in
the image of the absolute conic K⁻ᵀK⁻¹ (Zhang), and without skew two views in general position give K. Lenses that are
no pinhole have no homography in pixels, but every camera has one for bearings turned into the direction of the board:
for a guess of the focal length that gives the pose of every view, and the guess with the least reprojection error is
where to start.

References: Zhang, "A flexible new technique for camera calibration", PAMI 2000; Hartley & Zisserman, section 8.8.
"""

from typing import Any

import jax
import jax.numpy as jnp

from vojax._numerics import complement, safe_norm, safe_sqrt
from vojax._types import Array, Bool, Float
from vojax.ba._board_residual import BoardState, projections
from vojax.cameras import Pinhole
from vojax.lie import SE3, SO3
from vojax.solvers._symmetric import least_eigenvectors

from ._models import start_camera

# Focal lengths that are tried, in image widths: fields of view of about 150 to 14 degrees, for a lens in between.
FOCAL_RANGE = (0.15, 4.0)
FOCAL_STEPS = 18


def board_homography(
    board_xy: Float[Array, "n 2"], points: Float[Array, "n 2"], weight: Float[Array, " n"]
) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """Homography from the board's plane to an image, little disturbed by a few wrong corners.

    The direct linear transform, reweighted. `homography_dlt` of the solvers does one fit more accurately, and takes a
    compiler ten times as long.

    Returns:
        H, and whether it is determined.
    """
    counted = weight > 0
    board_xy, change0, spread0 = _to_unit_spread(board_xy, weight)
    points, change1, spread1 = _to_unit_spread(points, weight)
    one, zero = jnp.ones_like(weight), jnp.zeros_like(weight)
    p = jnp.stack([board_xy[:, 0], board_xy[:, 1], one], axis=1)
    none = jnp.stack([zero, zero, zero], axis=1)
    u, v = points[:, :1], points[:, 1:]
    rows = jnp.stack([jnp.concatenate([p, none, -u * p], axis=1), jnp.concatenate([none, p, -v * p], axis=1)])

    def reweighted(_: Any, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        robust = state[2]
        weighted = rows * (weight * robust)[None, :, None]
        gram = jnp.einsum("ani,anj->ij", weighted, rows, precision="highest")
        h, other = least_eigenvectors(gram, 2)
        gap = (other @ gram @ other) / jnp.maximum(jnp.trace(gram), 1e-30)
        h = h.reshape(3, 3)
        x, y, w = h @ p.T
        w = jnp.where(jnp.abs(w) > 1e-6, w, 1e-6)
        error = jnp.where(counted, jnp.hypot(x / w - points[:, 0], y / w - points[:, 1]), jnp.inf)
        # Cauchy's weights at the scale of the median error.
        middle = jnp.sort(error)[jnp.maximum(jnp.sum(counted) - 1, 0) // 2]
        scale = 3.0 * jnp.where(jnp.isfinite(middle), middle, 1.0) + 1e-5
        robust = 1.0 / (1.0 + jnp.where(counted, error / scale, 0.0) ** 2)
        # Collinear points leave two directions open.
        return h, gap > 64.0 * float(jnp.finfo(gram.dtype).eps), robust

    start = (jnp.eye(3, dtype=points.dtype), jnp.array(False), jnp.ones_like(weight))
    h, valid, _ = jax.lax.fori_loop(0, 4, reweighted, start)
    enough = (jnp.sum(counted) >= 4) & (spread0 > 0) & (spread1 > 0)
    back = jnp.stack(
        [jnp.stack([1.0 / change1[2], zero[0], change1[0]]), jnp.stack([zero[0], 1.0 / change1[2], change1[1]]),
         jnp.stack([zero[0], zero[0], one[0]])]
    )  # fmt: skip
    there = jnp.stack(
        [jnp.stack([change0[2], zero[0], -change0[2] * change0[0]]),
         jnp.stack([zero[0], change0[2], -change0[2] * change0[1]]), jnp.stack([zero[0], zero[0], one[0]])]
    )  # fmt: skip
    return back @ h @ there, valid & enough


def _to_unit_spread(x: Float[Array, "n 2"], weight: Float[Array, " n"]) -> tuple[Array, Array, Array]:
    """Points about their mean at a spread of one; (mean, factor); the spread."""
    seen = jnp.where(weight[:, None] > 0, x, 0.0)
    total = jnp.maximum(jnp.sum(weight), 1e-6)
    mean = jnp.sum(seen * weight[:, None], axis=0) / total
    relative = jnp.where(weight[:, None] > 0, seen - mean[None], 0.0)
    spread = safe_sqrt(jnp.sum(weight[:, None] * relative**2) / total)
    factor = jnp.where(spread > 0, 1.0 / jnp.where(spread > 0, spread, 1.0), 1.0)
    return relative * factor, jnp.append(mean, factor), spread


def zhang_intrinsics(
    homographies: Float[Array, "v 3 3"], valid: Bool[Array, " v"], width: int, height: int
) -> tuple[Float[Array, "4"], Bool[Array, ""]]:
    """Focal lengths and principal point of a pinhole camera without skew from homographies of a plane.

    Args:
        homographies: Of the board's plane to pixels.
        valid: Those that count.
        width: Of the image, for conditioning.
        height: Of the image.

    Returns:
        (fx, fy, cx, cy), and whether the equations have a camera for a solution.
    """
    size = (width + height) / 2.0
    centre = jnp.asarray([(width - 1.0) / 2.0, (height - 1.0) / 2.0], homographies.dtype)
    rows = homographies[:, :2] - centre[None, :, None] * homographies[:, 2:]
    h = jnp.concatenate([rows / size, homographies[:, 2:]], axis=1)
    h = h / jnp.maximum(jnp.sqrt(jnp.sum(h * h, axis=1, keepdims=True)[:, :, :1]), 1e-12)

    def equation(i: int, j: int) -> Array:
        # h_iᵀ B h_j for B without its entry 12.
        a, b = h[:, :, i], h[:, :, j]
        terms = (
            a[:, 0] * b[:, 0], a[:, 1] * b[:, 1], a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
            a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1], a[:, 2] * b[:, 2],
        )  # fmt: skip
        return jnp.stack(terms, axis=-1)

    both = jnp.concatenate([equation(0, 1), equation(0, 0) - equation(1, 1)])
    both = jnp.where(jnp.concatenate([valid, valid])[:, None], both, 0.0)
    # A share of all views: one with wrong corners must not decide.
    both = both / jnp.maximum(safe_norm(both), 1e-12)[:, None]
    _, vectors = jnp.linalg.eigh(both.T @ both)
    b11, b22, b13, b23, b33 = vectors[:, 0] * jnp.where(vectors[0, 0] < 0, -1.0, 1.0)
    proper = (b11 > 1e-9) & (b22 > 1e-9)
    b11, b22 = jnp.where(proper, b11, 1.0), jnp.where(proper, b22, 1.0)
    cx, cy = -b13 / b11, -b23 / b22
    rest = b33 - b13 * b13 / b11 - b23 * b23 / b22
    proper = proper & (rest > 0)
    rest = jnp.where(proper, rest, 1.0)
    fx, fy = jnp.sqrt(rest / b11) * size, jnp.sqrt(rest / b22) * size
    return jnp.stack([fx, fy, cx * size + centre[0], cy * size + centre[1]]), proper


def planar_pose(
    bearings: Float[Array, "n 3"], board_xy: Float[Array, "n 2"], weight: Float[Array, " n"]
) -> tuple[SE3, Float[Array, "3 3"], Bool[Array, ""]]:
    """Pose of a plane z = 0 from bearings, which may be more than 90 degrees off the axis.

    Returns:
        `cam_from_board`, the homography from the board to rays, and whether they are determined.
    """
    mean = jnp.sum(jnp.where(weight[:, None] > 0, bearings, 0.0), axis=0)
    length = safe_norm(mean)
    usable = length > 1e-3
    z = jnp.where(usable, mean / jnp.where(usable, length, 1.0), jnp.eye(3, dtype=mean.dtype)[2])
    x, y = complement((z[0], z[1], z[2]))
    turn = jnp.stack([jnp.stack(x), jnp.stack(y), z])
    turned = bearings @ turn.T
    ahead = turned[:, 2] > 0.05
    onto = turned[:, :2] / jnp.where(ahead, turned[:, 2], 1.0)[:, None]
    h, valid = board_homography(board_xy, jnp.where(ahead[:, None], onto, 0.0), jnp.where(ahead, weight, 0.0))
    h = jnp.where(valid & usable, h, jnp.eye(3, dtype=h.dtype))
    # The board is ahead: its depth in the middle is positive.
    total = jnp.maximum(jnp.sum(weight), 1e-6)
    middle = jnp.sum(jnp.where(weight[:, None] > 0, board_xy, 0.0) * weight[:, None], axis=0) / total
    h = h * jnp.where(h[2, 0] * middle[0] + h[2, 1] * middle[1] + h[2, 2] < 0, -1.0, 1.0)
    a, b = h[:, 0], h[:, 1]
    na, nb = (jnp.maximum(safe_norm(part), 1e-12) for part in (a, b))
    # The pair of orthogonal unit vectors nearest to both columns.
    p, q = a / na + b / nb, a / na - b / nb
    p, q = (part / jnp.maximum(safe_norm(part), 1e-12) for part in (p, q))
    r1, r2 = (p + q) * 0.5**0.5, (p - q) * 0.5**0.5
    rotation = jnp.stack([r1, r2, jnp.cross(r1, r2)], axis=1)
    pose = SE3.from_rotation_and_translation(SO3.from_matrix(turn.T @ rotation), turn.T @ (h[:, 2] * 2.0 / (na + nb)))
    return pose, turn.T @ h, valid & usable


def board_poses(
    camera: Any, corners: Float[Array, "v n 2"], board_points: Float[Array, "n 3"], weight: Float[Array, "v n"]
) -> tuple[SE3, Bool[Array, " v"]]:
    """Poses of the board in all views of a camera: `cam_from_board`, and which are determined."""
    bearings = camera.unproject(jnp.where(weight[..., None] > 0, corners, 0.0))
    poses, _, valid = jax.vmap(planar_pose, (0, None, 0))(bearings, board_points[:, :2], weight)
    return poses, valid


def start_single(
    template: Any,
    given: bool,
    corners: Float[Array, "v n 2"],
    board_points: Float[Array, "n 3"],
    weight: Float[Array, "v n"],
    image_size: tuple[int, int],
) -> tuple[Any, SE3, Bool[Array, " v"]]:
    """Camera and board poses to start from.

    Args:
        template: A camera of the model; its values count only where `given`.
        given: Whether the template is where to start.
        corners: Measured pixels.
        board_points: The same points in the board's frame, z = 0.
        weight: Of the corners.
        image_size: Width and height.

    Returns:
        The camera, the poses `cam_from_board`, and the views that have one.
    """
    if given:
        poses, valid = board_poses(template, corners, board_points, weight)
        return template, poses, valid
    width, height = image_size
    dtype = corners.dtype
    focal = jnp.geomspace(FOCAL_RANGE[0], FOCAL_RANGE[1], FOCAL_STEPS, dtype=dtype) * max(width, height)
    guesses = jnp.stack(
        [focal, focal, jnp.full_like(focal, (width - 1) / 2), jnp.full_like(focal, (height - 1) / 2)], axis=1
    )
    seen = jnp.where(weight[..., None] > 0, corners, 0.0)
    # A pinhole camera comes first: its homographies give Zhang's solution, which is tried last.
    pinhole = Pinhole(*guesses[FOCAL_STEPS // 2])
    guesses = jnp.concatenate([guesses[:1], guesses, guesses[:1]])
    cap = 0.2 * width

    def attempt(k: Array, best: tuple[Array, ...]) -> tuple[Array, ...]:
        least, chosen, best_poses, best_valid, closed = best
        guess = jnp.where(k == FOCAL_STEPS + 1, closed, guesses[k])
        camera = start_camera(template, guess)
        bearings = jnp.where(k == 0, pinhole.unproject(seen), camera.unproject(seen))
        poses, rays, valid = jax.vmap(planar_pose, (0, None, 0))(bearings, board_points[:, :2], weight)
        zhang, proper = zhang_intrinsics(jnp.einsum("ij,vjk->vik", pinhole.matrix(), rays), valid, width, height)
        closed = jnp.where((k == 0) & proper, zhang, closed)
        stacked = jax.tree.map(lambda leaf: leaf[None], camera)
        pixels = projections(BoardState(stacked, SE3.identity((1,), dtype=dtype), poses), board_points)[0]
        error = jnp.hypot(pixels[..., 0] - seen[..., 0], pixels[..., 1] - seen[..., 1])
        error = jnp.where((error < cap) & valid[:, None], error, cap)
        total = jnp.sum(jnp.where(weight > 0, error, 0.0))
        better = (total < least) & (k > 0)
        new = (total, guess, poses.wxyz_xyz, valid)
        kept = (jnp.where(better, x, y) for x, y in zip(new, (least, chosen, best_poses, best_valid), strict=True))
        return (*kept, closed)

    v = len(corners)
    identity = SE3.identity((v,), dtype=dtype).wxyz_xyz
    start = (jnp.asarray(jnp.inf, dtype), guesses[0], identity, jnp.zeros((v,), bool), guesses[0])
    _, guess, poses, valid, _ = jax.lax.fori_loop(0, FOCAL_STEPS + 2, attempt, start)
    return start_camera(template, guess), SE3(poses), valid
