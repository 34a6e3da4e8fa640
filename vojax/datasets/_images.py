"""A folder of images, or a video, and a calibration file."""

import os
import pathlib

import numpy as np
from jaxtyping import Float64

from vojax.cameras import Camera, CameraSet, read_cameras
from vojax.features import VideoReader, read_image

from ._pictures import check_index, check_size, image_files
from ._text import read_times


class ImageSequence:
    """Images of one camera: a folder of files or a video; they are read when asked for.

    Everything but the images is read and checked at once.

    Args:
        path: A folder of images, taken in the order of their names (numbers by value: 2.png before 10.png), or a video
            file.
        calibration: A file that `vojax.cameras.read_cameras` reads, or cameras already read.
        camera_name: Which camera of the calibration took the images; None where it holds only one.
        fps: Frames per second. None takes the rate that a video tells, and for a folder 1.
        times: A file of one time in seconds per frame, instead of `fps`.

    Attributes:
        name: Name of the folder or video, without suffix.
        camera: The camera.
        size: Width and height that the calibration is for; None where it does not tell.
        times: Seconds, one per frame.
        poses: None: there is no truth.
        frame_names: File names without suffix in order, or six digits per frame of a video.

    Raises:
        FileNotFoundError: A file is missing, or the folder holds no images.
        ValueError: The calibration or the times do not fit, or the video cannot be opened.
        ImportError: The calibration is YAML, and PyYAML is not installed.
    """

    name: str
    camera: Camera
    size: tuple[int, int] | None
    times: Float64[np.ndarray, "n"]
    poses: None
    frame_names: list[str]

    def __init__(
        self,
        path: str | os.PathLike[str],
        calibration: str | os.PathLike[str] | CameraSet,
        *,
        camera_name: str | None = None,
        fps: float | int | None = None,
        times: str | os.PathLike[str] | None = None,
    ):
        path = pathlib.Path(path)
        if fps is not None and times is not None:
            raise ValueError(f"both fps ({fps}) and a file of times ({times}): expected one of them")
        if fps is not None and not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"fps is {fps}: expected frames per second, more than 0")
        if not path.exists():
            raise FileNotFoundError(f"{path} not found: expected a folder of images or a video file")
        self.name = path.resolve().stem
        self.camera, self.size = _choose(calibration, camera_name)
        self._video, self._files = None, []
        if path.is_dir():
            self._files = image_files(path)
            self.frame_names = [file.stem for file in self._files]
        else:
            self._video = VideoReader(path)
            fps = self._video.fps if fps is None else fps
            self.frame_names = [f"{k:06d}" for k in range(len(self._video))]
        frames = len(self.frame_names)
        self.times = np.arange(frames) / (fps or 1.0) if times is None else read_times(pathlib.Path(times), frames)
        self.poses = None

    def __len__(self) -> int:
        """Number of frames; of a video, what its header tells."""
        return len(self.frame_names)

    def images(self, k: int) -> tuple[np.ndarray, None]:
        """Read frame `k`.

        Args:
            k: Index from 0 (negative ones count from the end). A video is fastest in order.

        Returns:
            The image (RGB where it has colour) and None in place of a right one.

        Raises:
            IndexError: There is no such frame.
            ValueError: The image is damaged or not of the size that the calibration is for, or the video ends early.
        """
        k = check_index(k, len(self), self.name)
        if self._video is None:
            image, where = read_image(self._files[k]), self._files[k]
        else:
            image, where = self._video.read(k), f"frame {k} of video {self._video.path}"
        check_size(image, where, self.camera, self.size)
        return image, None


def _choose(calibration: str | os.PathLike[str] | CameraSet, name: str | None) -> tuple[Camera, tuple[int, int] | None]:
    """The camera of a name, or the only one, and the size of its images."""
    source = "the calibration" if isinstance(calibration, CameraSet) else str(calibration)
    cameras = calibration if isinstance(calibration, CameraSet) else read_cameras(calibration)
    names = ", ".join(cameras.cameras)
    if name is None and len(cameras.cameras) > 1:
        raise ValueError(f"{source} holds cameras {names}: choose one with camera_name=")
    name = next(iter(cameras.cameras)) if name is None else name
    if name not in cameras.cameras:
        raise ValueError(f"{source} has no camera {name!r}: expected one of {names}")
    return cameras[name], cameras.sizes.get(name)
