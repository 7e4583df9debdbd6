"""Files of frames: videos and contact sheets. Frames are ``uint8 [T, H, W, 3]``."""

import contextlib
import importlib
from collections.abc import Generator
from pathlib import Path

import numpy as np
from PIL import Image

from fmpjax.errors import UserError

GIF_FPS = 50.0  # Hz; viewers slow faster ones down


def write_video(path: str | Path, frames: np.ndarray, fps: float) -> Path:
    """Write ``frames`` as ``.mp4``, or as ``.gif`` where that is asked for or no encoder is installed.

    Args:
      path: ends in ``.mp4`` or ``.gif``; missing folders are made.
      frames: ``uint8 [T, H, W, 3]``.
      fps: frames per second.

    Returns:
      The path that was really written.

    Raises:
      UserError: the path cannot be written, or there is nothing to write.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise UserError(f"cannot write a video to {path}: expected a name that ends in .mp4 or .gif")
    if len(frames) == 0:
        raise UserError(f"cannot write {path}: the video has no frames")
    encoder = _encoder() if path.suffix == ".mp4" else None
    path = path if encoder or path.suffix == ".gif" else path.with_suffix(".gif")
    with _writing(path):
        if encoder:
            _write_mp4(encoder, path, frames, fps)
        else:
            _write_gif(path, frames, fps)
    return path


def contact_sheet(path: str | Path, frames: np.ndarray, columns: int) -> Path:
    """Write ``frames`` (``uint8 [T, H, W, 3]``) as one PNG, row by row in a grid of ``columns``; returns its path.

    Raises:
      UserError: the path cannot be written, or there is nothing to write.
    """
    path, gap = Path(path), 4
    if len(frames) == 0 or columns < 1:
        raise UserError(f"cannot write {path}: expected at least one frame and one column")
    _, height, width, _ = frames.shape
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for i, frame in enumerate(frames):
        top, left = i // columns * (height + gap), i % columns * (width + gap)
        sheet[top : top + height, left : left + width] = frame
    with _writing(path):
        Image.fromarray(sheet).save(path, format="PNG")
    return path


@contextlib.contextmanager
def _writing(path: Path) -> Generator[None]:
    """Make the folder of ``path``; turn the system's refusal into a `UserError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        reason = error.strerror or str(error).strip().splitlines()[-1]
        raise UserError(f"cannot write {path}: {reason}") from error


def _encoder():
    """The module ``imageio_ffmpeg`` where it is installed with a program to run, else None."""
    try:
        encoder = importlib.import_module("imageio_ffmpeg")
        encoder.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return None
    return encoder


def _write_mp4(encoder, path: Path, frames: np.ndarray, fps: float) -> None:
    path.touch()  # the system's own words for a path that cannot be written
    # The format wants even sides.
    height, width = frames.shape[1] // 2 * 2, frames.shape[2] // 2 * 2
    writer = encoder.write_frames(
        str(path), (width, height), fps=fps, quality=6, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame[:height, :width]))
    writer.close()


def _write_gif(path: Path, frames: np.ndarray, fps: float) -> None:
    every = int(np.ceil(fps / GIF_FPS))
    # One palette for all frames, from the first and the last, keeps the colors from flickering.
    palette = Image.fromarray(np.concatenate([frames[0], frames[-1]])).quantize(255)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames[::every]]
    # The format counts in 10 ms: rounding the times, not the durations, keeps the speed right.
    ends = np.round(100 * every / fps * np.arange(len(images) + 1)).astype(int)
    durations = (10 * np.diff(ends)).tolist()
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)
