"""Absolute and relative errors of an estimated trajectory."""

import dataclasses
from typing import Literal

import jax
import numpy as np

from vojax._types import Float
from vojax.solvers import umeyama

from ._association import associate
from ._kitti import kitti_errors
from ._trajectory import Trajectory, rigid_inverse, rotation_angles

Alignment = Literal["none", "se3", "sim3"]
Origin = Literal["identity", "given"]


@dataclasses.dataclass(frozen=True)
class Metrics:
    """How far an estimated trajectory is from the truth.

    Attributes:
        ate_rmse_m: Root mean square of the position errors after `alignment`, metres.
        alignment: "none", "se3" or "sim3".
        ate_rmse_se3_m: The same after the best rigid alignment, whatever `alignment` is.
        ate_rmse_sim3_m: The same after the best similarity.
        drift_percent: Position error of the last pose over the length of the true path, after `alignment`; None where
            the camera never moved.
        rpe_trans_m: Root mean square of the translation errors from frame to frame, metres.
        rpe_rot_deg: Root mean square of the rotation errors from frame to frame, degrees.
        kitti_t_rel_percent: Mean translation error over stretches of 100 to 800 m; None on a path shorter than that.
        kitti_r_rel_deg_per_100m: Mean rotation error over the same stretches; None on a path shorter than that.
        path_length_m: Length of the true path, metres.
        scale: Factor that `alignment` applied to the estimate; 1 unless it is "sim3".
        frames: Poses that were compared.
    """

    ate_rmse_m: float
    alignment: str
    ate_rmse_se3_m: float
    ate_rmse_sim3_m: float
    drift_percent: float | None
    rpe_trans_m: float
    rpe_rot_deg: float
    kitti_t_rel_percent: float | None
    kitti_r_rel_deg_per_100m: float | None
    path_length_m: float
    scale: float
    frames: int

    def as_dict(self) -> dict[str, float | int | str | None]:
        """Field names and values, as `metrics.json` holds them."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True, eq=False)
class AlignedPair:
    """Two trajectories with matching poses in one frame.

    Attributes:
        estimate: The estimate after alignment.
        truth: The truth; pose i belongs to pose i of `estimate`, whose time it may miss by a little.
        scale: Factor that was applied to the estimate.
    """

    estimate: Trajectory
    truth: Trajectory
    scale: float

    @property
    def position_errors(self) -> Float[np.ndarray, "n"]:
        """Distances between matching positions, metres."""
        return np.linalg.norm(self.estimate.positions - self.truth.positions, axis=1)

    @property
    def rotation_errors_deg(self) -> Float[np.ndarray, "n"]:
        """Geodesic angles between matching orientations, degrees."""
        left = self.truth.world_from_cam[:, :3, :3].transpose(0, 2, 1)
        return np.degrees(rotation_angles(left @ self.estimate.world_from_cam[:, :3, :3]))


def align(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "none",
    *,
    origin: Origin = "identity",
    max_difference_s: float = 0.01,
) -> AlignedPair:
    """Pair the poses of two trajectories by time and bring them into one frame.

    Args:
        estimate: Estimated poses.
        truth: True poses.
        alignment: "none", or the rigid ("se3") or similarity ("sim3") transform of the estimate that brings its
            positions closest to the true ones in the least-squares sense.
        origin: "identity" first expresses both trajectories in the frame of their first common pose; "given" leaves
            them as they are.
        max_difference_s: Largest difference of matching times, seconds.

    Returns:
        The common poses of both, the estimate aligned.

    Degenerate input: where positions do not determine the alignment (fewer than three, or all on one line), the
    orientations settle what is left open; where one of the cameras stands still the scale stays 1.

    Raises:
        ValueError: An unknown option, or no times in common.

    References: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    if alignment not in ("none", "se3", "sim3"):
        raise ValueError(f"unknown alignment {alignment!r}; expected 'none', 'se3' or 'sim3'")
    if origin not in ("identity", "given"):
        raise ValueError(f"unknown origin {origin!r}; expected 'identity' or 'given'")
    in_estimate, in_truth = associate(estimate.timestamps, truth.timestamps, max_difference_s)
    if in_estimate.size == 0:
        raise ValueError(
            f"estimate and truth share no times within {max_difference_s} s: the estimate spans "
            f"{_span(estimate)}, the truth {_span(truth)}"
        )
    estimate, truth = estimate.select(in_estimate), truth.select(in_truth)
    if origin == "identity":
        estimate, truth = estimate.from_origin(), truth.from_origin()
    if alignment == "none":
        return AlignedPair(estimate, truth, 1.0)
    scale, truth_from_estimate = _best_transform(estimate, truth, alignment)
    poses = np.array(estimate.world_from_cam)
    poses[:, :3, 3] *= scale
    return AlignedPair(Trajectory(estimate.timestamps, truth_from_estimate[None] @ poses), truth, scale)


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "none",
    *,
    origin: Origin = "identity",
    max_difference_s: float = 0.01,
) -> Metrics:
    """Measure an estimated trajectory against the truth.

    Args:
        estimate: Estimated poses.
        truth: True poses, metres.
        alignment: "none" for sensors that see scale, "sim3" for a single camera; see `align`.
        origin: "identity" lets both trajectories start at the identity; "given" compares them as they are.
        max_difference_s: Largest difference of matching times, seconds.

    Returns:
        The metrics over the common poses.

    Degenerate input: see `align`. What a path is too short for is None.

    Raises:
        ValueError: An unknown option, or fewer than two times in common.

    References: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012 (ATE, RPE); Geiger et
    al., CVPR 2012 (KITTI).
    """
    pair = align(estimate, truth, alignment, origin=origin, max_difference_s=max_difference_s)
    if len(pair.truth) < 2:
        raise ValueError("estimate and truth share a single time; expected at least two")

    def ate(other: Alignment) -> float:
        if other == alignment:
            return _rms(pair.position_errors)
        return _rms(align(estimate, truth, other, origin=origin, max_difference_s=max_difference_s).position_errors)

    path_length = pair.truth.path_length
    estimated, true = pair.estimate.world_from_cam, pair.truth.world_from_cam
    # Motion error from frame to frame: (true step)^-1 (estimated step).
    step_error = rigid_inverse(rigid_inverse(true[:-1]) @ true[1:]) @ (rigid_inverse(estimated[:-1]) @ estimated[1:])
    kitti = kitti_errors(estimated, true)
    return Metrics(
        ate_rmse_m=_rms(pair.position_errors),
        alignment=alignment,
        ate_rmse_se3_m=ate("se3"),
        ate_rmse_sim3_m=ate("sim3"),
        drift_percent=float(100.0 * pair.position_errors[-1] / path_length) if path_length > 0 else None,
        rpe_trans_m=_rms(np.linalg.norm(step_error[:, :3, 3], axis=1)),
        rpe_rot_deg=_rms(np.degrees(rotation_angles(step_error[:, :3, :3]))),
        kitti_t_rel_percent=kitti.t_rel_percent,
        kitti_r_rel_deg_per_100m=kitti.r_rel_deg_per_100m,
        path_length_m=path_length,
        scale=pair.scale,
        frames=len(pair.truth),
    )


def _best_transform(
    estimate: Trajectory, truth: Trajectory, alignment: Alignment
) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """Scale and rigid transform that bring the scaled positions of `estimate` closest to those of `truth`."""
    found = _fit(estimate.positions, truth.positions, alignment)
    if found is not None:
        return found
    # Positions on one line, or fewer than three, leave a rotation open. Points fixed to the cameras settle it by the
    # orientations; they sit so close to the cameras that the positions keep their say.
    spread = [float(np.sqrt(np.var(t.positions, axis=0).sum())) for t in (estimate, truth)]
    if alignment == "sim3" and min(spread) > 1e-9 * max(spread):
        reach = [1e-4 * spread[0], 1e-4 * spread[1]]
    else:
        alignment = "se3"
        reach = [1e-4 * max(spread) if max(spread) > 0 else 1.0] * 2
    found = _fit(_attached_points(estimate, reach[0]), _attached_points(truth, reach[1]), alignment)
    return (1.0, np.eye(4)) if found is None else found


_similarity = jax.jit(umeyama)


def _fit(
    points0: Float[np.ndarray, "n 3"], points1: Float[np.ndarray, "n 3"], alignment: Alignment
) -> tuple[float, Float[np.ndarray, "4 4"]] | None:
    mean0, mean1 = points0.mean(axis=0), points1.mean(axis=0)
    # Least squares sees the centred points through their second moments alone, and so do the six rows of the
    # triangular factor; with their negatives they are centred too. One compilation then serves every length.
    rows = np.linalg.qr(np.concatenate([points0 - mean0[None], points1 - mean1[None]], axis=1), mode="r")
    rows = np.pad(rows, ((0, 6 - len(rows)), (0, 0)))
    rows = np.concatenate([rows, -rows])
    with jax.enable_x64(True):
        found = _similarity(rows[:, :3], rows[:, 3:])
        if not bool(found.valid[0]):
            return None
        rotation = np.asarray(found.models.rotation().as_matrix()[0])
        # The best rotation is the same with and without scale.
        scale = float(found.models.scale()[0]) if alignment == "sim3" else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = mean1 - scale * rotation @ mean0
    return scale, matrix


def _attached_points(trajectory: Trajectory, reach: float) -> Float[np.ndarray, "m 3"]:
    """Camera centres and, `reach` away from each, the six points on its axes."""
    axes = reach * trajectory.world_from_cam[:, :3, :3].transpose(0, 2, 1)
    centres = trajectory.positions[:, None, :]
    return np.concatenate([centres, centres + axes, centres - axes], axis=1).reshape(-1, 3)


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _span(trajectory: Trajectory) -> str:
    return f"{float(trajectory.timestamps[0])!r} to {float(trajectory.timestamps[-1])!r} s"
