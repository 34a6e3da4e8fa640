"""A run in the rerun viewer: image and tracks, camera and path, truth, and the number of inliers."""

import pathlib
from typing import Any

import numpy as np

from vojax.odometry import FrameEstimate

from ._open_sequence import FrameSource
from ._run import true_trajectory

# Steps to a line: a line is sent anew with each pose, so that one for the whole path would grow quadratically.
_CHUNK = 100


class RerunViewer:
    """Streams a run to the viewer, which it starts, or into a file. Use as a context around the run.

    Args:
        source: What is run.
        file: Where to record; None starts the viewer.

    Raises:
        ImportError: rerun is not installed.
        OSError: The file's folder does not exist.
    """

    def __init__(self, source: FrameSource, file: pathlib.Path | None):
        try:
            import rerun  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError("--rerun needs rerun, which is not installed: pip install 'vojax[rerun]'") from None
        if file is not None and not file.parent.is_dir():
            raise FileNotFoundError(f"{file.parent}: no such folder to write {file.name} in")
        self._rerun: Any = rerun
        self._times = source.sequence.times
        self._camera: Any = getattr(source.sequence, "camera", None)
        self._seen = False
        self._path: list[np.ndarray] = []
        self._recording = rerun.RecordingStream(f"vojax {source.sequence.name}")
        if file is None:
            self._recording.spawn()
        else:
            self._recording.save(file)
        # Cameras look along z with y down, and so does the world, which is the first of them.
        self._recording.log("world", rerun.ViewCoordinates.RDF, static=True)
        truth = true_trajectory(source.sequence, len(source.sequence))
        if truth is not None:
            line = rerun.LineStrips3D([truth.from_origin().positions], colors=[[156, 163, 175]])
            self._recording.log("world/truth", line, static=True)

    def __enter__(self) -> "RerunViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.disconnect()

    def frame(self, k: int, image: np.ndarray, estimate: FrameEstimate) -> None:
        """Log a frame's image, its tracks and the number of its inliers."""
        rerun = self._rerun
        self._at(k)
        if not self._seen:
            self._seen = True
            self._log_pinhole(image)
        self._recording.log("world/camera/image", rerun.Image(image[..., :3] if image.ndim == 3 else image).compress())
        tracks = np.stack([estimate.previous_pixels, estimate.pixels], axis=1)
        self._recording.log("world/camera/image/tracks", rerun.LineStrips2D(tracks, colors=[[0, 114, 178]]))
        self._recording.log("inliers", rerun.Scalars([int(estimate.num_inliers)]))

    def pose(self, k: int, world_from_cam: np.ndarray) -> None:
        """Log the pose of frame `k` and the path up to it."""
        rerun = self._rerun
        self._at(k)
        rotation, position = world_from_cam[:3, :3], world_from_cam[:3, 3]
        self._recording.log("world/camera", rerun.Transform3D(mat3x3=rotation, translation=position))
        if len(self._path) > _CHUNK:
            self._path = self._path[-1:]
        self._path.append(position)
        line = rerun.LineStrips3D([np.stack(self._path)], colors=[[0, 114, 178]])
        self._recording.log(f"world/path/{max(k - 1, 0) // _CHUNK}", line)

    def _at(self, k: int) -> None:
        self._recording.set_time("frame", sequence=k)
        self._recording.set_time("time", duration=float(self._times[k] - self._times[0]))

    def _log_pinhole(self, image: np.ndarray) -> None:
        """The camera's pyramid in space; of a camera with distortion, the one without."""
        camera = self._camera
        if all(hasattr(camera, name) for name in ("fx", "fy", "cx", "cy")):
            matrix = [[float(camera.fx), 0, float(camera.cx)], [0, float(camera.fy), float(camera.cy)], [0, 0, 1]]
            height, width = image.shape[:2]
            axes = self._rerun.ViewCoordinates.RDF
            pinhole = self._rerun.Pinhole(image_from_camera=matrix, width=width, height=height, camera_xyz=axes)
            self._recording.log("world/camera/image", pinhole, static=True)
