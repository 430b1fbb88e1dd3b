"""Animations of episodes, as mp4 or gif files."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.options import UsageError

if TYPE_CHECKING:
    import numpy as np

ENDINGS = (".mp4", ".gif")
_PACKAGES = {".mp4": ("imageio_ffmpeg", "imageio-ffmpeg"), ".gif": ("PIL", "pillow")}


def check_video(path: Path) -> None:
    """Find out whether a file can be made, before the episodes are played.

    :param path: the file to write, ending in one of ``ENDINGS``
    :raises UsageError: if a package is missing
    """
    module, package = _PACKAGES[path.suffix.lower()]
    if find_spec(module) is None:
        raise UsageError(
            f"argument --video: a {path.suffix} file needs {package}: pip install "
            "'sb3_roles[video]'"
        )


class VideoWriter:
    """Writes frames to a file; a context manager. The file appears when it is complete.

    Equal consecutive frames of a gif become one that is shown longer.

    :param path: ending in ``.mp4`` or ``.gif``
    :param fps: frames per second
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path = path
        self.fps = fps
        self.n_frames = 0
        self._partial = path.with_name(f".{path.stem}.partial{path.suffix}")
        self._ffmpeg: Any = None
        self._images: list[Any] = []

    def __enter__(self) -> VideoWriter:
        return self

    def add(self, frame: np.ndarray) -> None:
        """Append a frame.

        :param frame: uint8 (height, width, 3), each of the size of the first
        """
        # Numpy and the encoders are not loaded before the arguments are known to be right.
        import numpy as np

        self.n_frames += 1
        if self.path.suffix.lower() == ".gif":
            image = import_module("PIL.Image").fromarray(frame)
            # Indexed at once: a long animation of full-color frames would take gigabytes.
            self._images.append(image.quantize(256))
            return
        # H.264 asks for even sides.
        frame = np.pad(frame, [(0, n % 2) for n in frame.shape[:2]] + [(0, 0)], mode="edge")
        if self._ffmpeg is None:
            self._ffmpeg = import_module("imageio_ffmpeg").write_frames(
                str(self._partial),
                (frame.shape[1], frame.shape[0]),
                fps=self.fps,
                macro_block_size=2,
                ffmpeg_log_level="error",
            )
            self._ffmpeg.send(None)
        self._ffmpeg.send(np.ascontiguousarray(frame))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if self._ffmpeg is not None:
                self._ffmpeg.close()
            if kind is None and self._images:
                first, *others = self._images
                first.save(
                    self._partial,
                    save_all=True,
                    append_images=others,
                    duration=round(1000 / self.fps),
                    loop=0,
                )
            if kind is None and self.n_frames:
                os.replace(self._partial, self.path)
        finally:
            self._partial.unlink(missing_ok=True)
