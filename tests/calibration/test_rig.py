"""Two cameras calibrated together: truth, and what leaves a rig open."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax import SE3, Result
from vojax.calibration import calibrate_rig
from vojax.cameras import Pinhole

SIZE = (640, 480)
# Views 0 to 3 of the first camera, 4 to 7 of the second.
_ALTERNATING = np.repeat(np.array([[True] * 4 + [False] * 4, [False] * 4 + [True] * 4])[:, :, None], 30, axis=2)


@pytest.fixture(scope="module")
def pair(views, board):
    """Corners of two pinhole cameras with noise of 0.2 pixels, cameras and true relative pose."""
    with jax.enable_x64(True):
        cameras = (Pinhole(500.0, 505.0, 318.0, 242.0), Pinhole(530.0, 528.0, 322.0, 238.0))
        right_from_left = SE3.exp(jnp.array([-1.2, 0.05, 0.1, 0.02, -0.08, 0.01]))
        # Farther than one camera needs it: both have to see the whole board.
        left = SE3(views[1].wxyz_xyz + jnp.zeros(7).at[6].set(2.5)[None])
        poses = (left, SE3(jnp.tile(right_from_left.wxyz_xyz[None], (8, 1))) @ left)
        corners = np.stack(
            [
                [np.asarray(camera.project(SE3(pose).apply(jnp.asarray(board)))) for pose in own.wxyz_xyz]
                for camera, own in zip(cameras, poses, strict=True)
            ]
        )
        noise = np.random.default_rng(5).normal(size=corners.shape)
        return corners + 0.2 * noise, cameras, right_from_left


@pytest.mark.slow
def test_the_truth_is_within_its_deviations(pair, board, x64):
    corners, cameras, right_from_left = pair
    mask = np.ones(corners.shape[:3], bool)
    mask[1, 2] = False  # the right camera misses a view
    found = calibrate_rig(corners, board, SIZE, model=Pinhole, mask=mask)
    assert found.result == Result.success
    assert not bool(found.used[1, 2])
    assert found.names[:5] == ("camera0.fx", "camera0.fy", "camera0.cx", "camera0.cy", "camera1.fx")
    names = ("fx", "fy", "cx", "cy")
    error = [
        float(getattr(own, name) - getattr(true, name))
        for own, true in zip(found.rig.cameras, cameras, strict=True)
        for name in names
    ]
    pose = SE3(found.rig.cam_from_rig.wxyz_xyz[1]) @ right_from_left.inverse()
    score = np.concatenate([error, np.asarray(pose.log())]) / np.asarray(found.standard_deviations())
    assert np.abs(score).max() < 4.0
    assert float(found.sigma_px) == pytest.approx(0.2, abs=0.03)
    np.testing.assert_array_equal(np.asarray(found.rig.cam_from_rig.wxyz_xyz[0]), [1, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"corners": np.zeros((1, 8, 30, 2))}, "expected two or more"),
        ({"model": (Pinhole,)}, "1 models for 2 cameras"),
        ({"mask": np.arange(480).reshape(2, 8, 30) < 300}, "camera 1: 2 views with at least 4 corners"),
        ({"mask": _ALTERNATING}, "camera 1 has no view in common"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(pair, board, change, words, x64):
    arguments = {"corners": pair[0], "object_points": board, "image_size": SIZE, **change}
    positional = [arguments.pop(name) for name in ("corners", "object_points", "image_size")]
    with pytest.raises(ValueError, match=r"\w") as caught:
        inspect.unwrap(calibrate_rig)(*positional, **arguments)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
