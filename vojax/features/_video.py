"""Video files in, frames out; what a decoder would skip or end at in silence is an error here."""

import os
import pathlib

import cv2
import numpy as np
from jaxtyping import UInt8


class VideoReader:
    """Read the frames of a video by their number.

    In order it decodes each frame once. A step forward decodes those between, a step back starts over from the first:
    seeking in compressed video does not hit the frame exactly. One thread at a time.

    Args:
        path: A file in any format that OpenCV's FFmpeg decodes (MP4, AVI, MKV, …).

    Attributes:
        path: The file.
        fps: Frames per second as the file tells; None where it does not.

    Degenerate input: the number of frames is what the file's header tells (they are counted where it does not). A frame
    that cannot be decoded, and one after a premature end, raise when read. Damage that the decoder papers over, as
    H.264's error concealment does, is not noticed; a frame that the container has lost moves up those behind it, and
    the last one is then missing. FFmpeg itself prints to stderr what it finds damaged (`OPENCV_FFMPEG_LOGLEVEL=-8` in
    the environment keeps it quiet).

    Raises:
        FileNotFoundError: No such file.
        ValueError: The file is no video, or none of its frames can be decoded.
    """

    path: pathlib.Path
    fps: float | None

    def __init__(self, path: str | os.PathLike[str]):
        self.path = pathlib.Path(path)
        if not self.path.exists():
            raise FileNotFoundError(f"video {self.path} not found: check the path")
        self._capture = self._open()
        self._next = 0  # the frame that is grabbed next
        self._in_hand: int | None = None  # the one grabbed last, if it could be decoded
        self._found = 0  # frames up to the last that could be decoded
        self._ended = False
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(fps) if np.isfinite(fps) and fps > 0 else None
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        # Some streams have no header to tell.
        self._frames = int(count) if np.isfinite(count) and count >= 1 else self._count()
        if self._frames == 0:
            raise ValueError(f"video {self.path} holds no frame that can be decoded: expected at least one")

    def __len__(self) -> int:
        """Number of frames, as the file's header tells."""
        return self._frames

    def read(self, k: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decode frame `k`.

        Args:
            k: Index from 0.

        Returns:
            The frame, RGB.

        Raises:
            IndexError: There is no such frame.
            ValueError: The frame is damaged, or the video ends before it.
        """
        if not 0 <= k < self._frames:
            raise IndexError(f"frame {k} of video {self.path}: expected 0 to {self._frames - 1}")
        if self._ended and k >= self._found:
            raise self._early_end(k)
        if k != self._in_hand:
            if k < self._next:
                self._capture, self._next = self._open(), 0
            # A damaged frame fails and takes its turn like any other.
            while self._next <= k:
                self._grab()
        decoded, image = self._capture.retrieve() if k == self._in_hand else (False, None)
        if not decoded or image is None:
            raise self._failure(k)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG) if self.path.is_file() else None
        if capture is None or not capture.isOpened():
            raise ValueError(f"video {self.path} cannot be opened: expected a whole video file (MP4, AVI, MKV, …)")
        return capture

    def _count(self) -> int:
        count = 0
        while self._capture.grab():
            count += 1
        self._capture = self._open()
        return count

    def _grab(self) -> bool:
        decoded = self._capture.grab()
        self._in_hand = self._next if decoded else None
        self._next += 1
        if decoded:
            self._found = max(self._found, self._next)
        return decoded

    def _failure(self, k: int) -> ValueError:
        """What befell frame `k`: the end of the video, if nothing can be decoded after it."""
        while self._next < self._frames:
            if self._grab():
                break
        if self._found > k:
            return ValueError(f"frame {k} of video {self.path} is damaged: expected a frame that can be decoded")
        self._ended = True
        return self._early_end(k)

    def _early_end(self, k: int) -> ValueError:
        return ValueError(
            f"frame {k} of video {self.path} is missing: the video ends after {self._found} frames, expected "
            f"{self._frames} from its header"
        )
