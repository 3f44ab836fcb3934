"""Frames into a GIF or an MP4."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import subprocess
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]

# Frames per second from which on what moves is seen to move. A GIF has few of them: it is large.
FRAME_RATES = {".gif": 12.0, ".mp4": 25.0}
# What writes each: module, package, extra, and what else can be done.
_WRITERS = {
    ".gif": ("PIL", "pillow", "bench", ""),
    ".mp4": ("imageio_ffmpeg", "imageio-ffmpeg", "video", "; or write a .gif"),
}
# A GIF's palette is taken from so many frames. Its first half are the commonest colours, which
# are the areas of the drawing, exact; the rest are others that are far from all of these: fewer
# shades at the edges take fewer bytes.
_PALETTE_FRAMES = 8
_PALETTE_SIZE = 64
_NEAREST_AREAS, _NEAREST_SHADES = 6.0, 32.0


def check_video_path(path: Path) -> None:
    """Check the suffix of a video, and that what writes it is installed.

    Raises:
        ValueError: The suffix is neither .gif nor .mp4.
        ImportError: The package that writes this kind is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in FRAME_RATES:
        raise ValueError(f"video {str(path)!r} must end in .gif or .mp4")
    _writer(suffix)


def video_bytes(kind: str, frames: Iterable[Frame], rate: float) -> bytes:
    """Return the content of a video.

    Args:
        kind: ".gif" or ".mp4".
        frames: Each of one shape (height, width, 3), height and width even.
        rate: Frames per second. A GIF counts in hundredths of a second and takes the nearest.

    Raises:
        ValueError: There is no frame.
        ImportError: The package that writes this kind is not installed.
        OSError: There is no room for it.
    """
    return gif_bytes(frames, rate) if kind == ".gif" else _mp4_bytes(frames, rate)


def gif_bytes(frames: Iterable[Frame], rate: float) -> bytes:
    """Return the frames as a GIF that repeats, with one palette for all of them; see `video_bytes`.

    One palette without dithering leaves what does not move unchanged from frame to frame, and what
    is unchanged is left out.
    """
    _writer(".gif")
    from PIL import Image

    # Drawings compress a hundredfold, so that a long episode fits into memory.
    packed, shape = [], (0, 0, 0)
    for frame in frames:
        packed.append(zlib.compress(np.ascontiguousarray(frame).tobytes(), 1))
        shape = frame.shape
    if not packed:
        raise ValueError("there is no frame to write")

    def unpacked(data: bytes) -> Any:
        return Image.fromarray(np.frombuffer(zlib.decompress(data), np.uint8).reshape(shape))

    chosen = np.unique(np.linspace(0, len(packed) - 1, _PALETTE_FRAMES).round().astype(int))
    sample = np.concatenate([np.asarray(unpacked(packed[index])) for index in chosen])
    palette = Image.new("P", (1, 1))
    palette.putpalette(common_colours(sample).ravel().tolist())
    images = (unpacked(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in packed)
    # In hundredths of a second, rounded so that the whole takes as long as it should.
    instants = np.round(100.0 / rate * np.arange(len(packed) + 1)).astype(int)
    stream = io.BytesIO()
    next(images).save(
        stream,
        format="GIF",
        save_all=True,
        append_images=images,
        # [ms]; viewers slow down what is faster.
        duration=np.maximum(20, 10 * np.diff(instants)).tolist(),
        loop=0,
        optimize=True,  # leaves out what has not changed
        disposal=1,
    )
    return stream.getvalue()


def common_colours(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the palette of pixels (..., 3), commonest colours first, shape (at most 64, 3)."""
    red, green, blue = np.moveaxis(pixels.reshape(-1, 3).astype(np.int64), -1, 0)
    codes, counts = np.unique((red << 16) | (green << 8) | blue, return_counts=True)
    codes = codes[np.argsort(-counts, kind="stable")]
    left = np.stack([codes >> 16, (codes >> 8) & 255, codes & 255], axis=-1)
    chosen: list[NDArray[np.int64]] = []
    while left.size and len(chosen) < _PALETTE_SIZE:
        chosen.append(left[0])
        nearest = _NEAREST_AREAS
        if len(chosen) >= _PALETTE_SIZE // 2:
            # From here on what is near an area counts as that area, too.
            nearest = _NEAREST_SHADES
        apart = np.min(np.sum((left[:, None] - np.array(chosen)[None]) ** 2, axis=-1), axis=1)
        left = left[apart >= nearest**2]
    return np.array(chosen, np.uint8)


def _mp4_bytes(frames: Iterable[Frame], rate: float) -> bytes:
    ffmpeg = _writer(".mp4")
    iterator: Iterator[Frame] = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise ValueError("there is no frame to write")
    height, width, _ = first.shape
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:.6g}"]
    # yuv420p is what every player shows; faststart lets a page play it while it loads.
    coded = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart"]
    quiet = [ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    with tempfile.TemporaryDirectory(prefix="lagros-") as folder:
        # ffmpeg tells the format from the suffix.
        film = Path(folder) / "film.mp4"
        command = [*quiet, *raw, "-i", "-", "-an", *coded, str(film)]
        with tempfile.TemporaryFile() as complaints:
            # If ffmpeg gives up it closes the pipe, and its return code says so.
            with (
                contextlib.suppress(BrokenPipeError),
                subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints) as process,
            ):
                for frame in itertools.chain([first], iterator):
                    cast(IO[bytes], process.stdin).write(np.ascontiguousarray(frame).tobytes())
            if process.returncode != 0:
                complaints.seek(0)
                text = complaints.read().decode(errors="replace").strip()
                raise OSError(f"ffmpeg could not make the film: {text}")
        return film.read_bytes()


def _writer(kind: str) -> Any:
    """Import what writes a kind of film."""
    module, package, extra, instead = _WRITERS[kind]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{'a' if kind == '.gif' else 'an'} {kind} needs {package}, which is not installed: "
            f'pip install "lagros[{extra}]"{instead}'
        ) from error
