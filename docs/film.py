"""Make the film of the README and of the site's first page: two flights of (c), side by side.

    python docs/film.py            # writes docs/images/film.gif

It is what these two commands show, without the legend of the second, on one clock:

    lagros watch cartpole --policy lagros --disturbance gust --seed 3 --video cartpole.gif
    lagros watch spacecraft --policy lagros --seed 1 --video spacecraft.gif
"""

from __future__ import annotations

import io
import shlex
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

from lagros_envs.files import write_atomic

FILM = Path(__file__).parent / "images" / "film.gif"
COMMANDS = [line.strip() for line in (__doc__ or "").splitlines() if "lagros watch" in line]
# Width that is kept of each picture, and its width in the film [pixels].
KEPT, SHOWN, HEIGHT = (800, 640), (640, 320), 320
FRAMES, SHOWN_FOR = 96, 125  # [ms]


def frames(path: Path, kept: int, width: int) -> list[Image.Image]:
    """Return FRAMES pictures of a film, spread evenly over it, cut and made smaller."""
    film = Image.open(path)
    last: int = getattr(film, "n_frames", 1) - 1
    found = []
    for index in range(FRAMES):
        film.seek(round(index * last / (FRAMES - 1)))
        picture = film.convert("RGB").crop((0, 0, kept, film.height))
        found.append(picture.resize((width, HEIGHT), Image.Resampling.LANCZOS))
    return found


def main() -> None:
    """Fly both, and write the film."""
    with tempfile.TemporaryDirectory() as folder:
        films = []
        for command, kept, width in zip(COMMANDS, KEPT, SHOWN, strict=True):
            words = shlex.split(command)
            subprocess.run(words, cwd=folder, check=True)
            films.append(frames(Path(folder) / words[-1], kept, width))
    pictures = []
    for left, right in zip(*films, strict=True):
        picture = Image.new("RGB", (sum(SHOWN), HEIGHT))
        picture.paste(left, (0, 0))
        picture.paste(right, (SHOWN[0], 0))
        pictures.append(picture)
    # One palette for all frames, without dithering: what stands still is stored once.
    palette = pictures[len(pictures) // 2].quantize(96, Image.Quantize.MAXCOVERAGE)
    reduced = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    kept_in = io.BytesIO()
    reduced[0].save(
        kept_in,
        "GIF",
        save_all=True,
        append_images=reduced[1:],
        duration=SHOWN_FOR,
        loop=0,
        optimize=True,
    )
    write_atomic(FILM, kept_in.getvalue())


if __name__ == "__main__":
    main()
