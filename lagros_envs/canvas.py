"""A canvas for the environments' pictures: pygame, its window, the colours and the strokes."""

from __future__ import annotations

import math
import os
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

Colour = tuple[int, int, int]
Point = tuple[float, float]

# Okabe and Ito's palette, which colour-blind readers tell apart.
BLACK: Colour = (0, 0, 0)
ORANGE: Colour = (230, 159, 0)
SKY_BLUE: Colour = (86, 180, 233)
GREEN: Colour = (0, 158, 115)
BLUE: Colour = (0, 114, 178)
VERMILLION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)
WHITE: Colour = (255, 255, 255)
GREY: Colour = (110, 110, 110)
PALE: Colour = (225, 225, 225)

# Frames are drawn larger and shrunk, which smooths every edge.
OVERSAMPLING = 2
SHORTEST_ARROW = 3.0  # anything less is not drawn [px]


def import_pygame() -> ModuleType:
    """Import pygame, without its greeting.

    Raises:
        ImportError: The extra `lagros[render]` is not installed.
    """
    # A library has no business printing a greeting.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise ImportError(
            'rendering needs pygame, which is not installed: pip install "lagros[render]"'
        ) from error
    return pygame


def mix(colour: Colour, share: float) -> Colour:
    """Fade a colour towards white; a share of 1 leaves it as it is."""
    red, green, blue = (round(share * part + (1.0 - share) * 255) for part in colour)
    return red, green, blue


class Canvas:
    """An enlarged canvas, its window, and strokes in the pixels of the canvas.

    Only the mode "human" opens a window; "rgb_array" needs no display. pygame has one window in a
    process: who draws in it last has opened it anew. A copy, or one that was pickled, prepares what
    it needs of pygame when it draws.

    Args:
        render_mode: "human" or "rgb_array".
        fps: Frames per second at which "human" plays.
        size: Width and height of the frame [px].
        caption: Of the window.
        fonts: Sizes of the letters that are used [px].

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(
        self,
        render_mode: str,
        fps: int,
        size: tuple[int, int],
        caption: str,
        fonts: tuple[int, ...],
    ) -> None:
        self._seen = render_mode == "human"
        self._fps, self._size, self._caption, self._heights = fps, size, caption, fonts
        self._prepare()

    def _prepare(self) -> None:
        library = self._pygame = import_pygame()
        self._window: pygame.Surface | None = None
        self._clock = library.time.Clock()
        self._make_fonts()
        width, height = self._size
        self._canvas = library.Surface((width * OVERSAMPLING, height * OVERSAMPLING))
        if self._seen:
            self._open()

    def _make_fonts(self) -> None:
        fonts = self._pygame.font
        fonts.init()
        self._fonts = {height: fonts.Font(None, height * OVERSAMPLING) for height in self._heights}

    def _open(self) -> None:
        display = self._pygame.display
        display.init()
        self._window = display.set_mode(self._size)
        display.set_caption(self._caption)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to pygame, which cannot be copied."""
        own = {"_pygame", "_window", "_clock", "_fonts", "_canvas"}
        return {name: value for name, value in self.__dict__.items() if name not in own}

    def close(self) -> None:
        """Close the window, if it is ours."""
        if self._window is not None and self._is_open():
            self._pygame.display.quit()
        self._window = None

    def _is_open(self) -> bool:
        """Return whether pygame's window is ours, or looks just like it."""
        display = self._pygame.display
        surface = display.get_surface()
        return (
            surface is not None
            and surface.get_size() == self._size
            and display.get_caption()[0] == self._caption
        )

    def _clear(self) -> None:
        """Begin a frame."""
        if not hasattr(self, "_pygame"):
            self._prepare()
        # Someone else may have opened a window, or closed all of pygame.
        if self._seen and not self._is_open():
            self._open()
        self._canvas.fill(WHITE)

    def _shown(self) -> NDArray[np.uint8] | None:
        """Show what was drawn: in the window, or as the frame (height, width, 3) without one."""
        pygame = self._pygame
        frame = pygame.transform.smoothscale(self._canvas, self._size)
        if self._window is None:
            # pygame counts columns first.
            return np.transpose(pygame.surfarray.array3d(frame), (1, 0, 2)).copy()
        self._window.blit(frame, (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)
        return None

    def _line(self, start: Point, end: Point, colour: Colour, width: float) -> None:
        # A polygon: pygame cuts the ends of its own thick lines along the axes.
        across, down = end[0] - start[0], end[1] - start[1]
        share = 0.5 * width * OVERSAMPLING / max(1e-9, math.hypot(across, down))
        side, rise = -share * down, share * across
        corners = [
            (start[0] + side, start[1] + rise),
            (end[0] + side, end[1] + rise),
            (end[0] - side, end[1] - rise),
            (start[0] - side, start[1] - rise),
        ]
        self._pygame.draw.polygon(self._canvas, colour, corners)

    def _dashed(self, start: Point, end: Point, colour: Colour, width: float) -> None:
        across, down = end[0] - start[0], end[1] - start[1]
        count = max(1, round(math.hypot(across, down) / (12 * OVERSAMPLING)))
        for dash in range(count):
            first, second = dash / count, (dash + 0.55) / count
            self._line(
                (start[0] + first * across, start[1] + first * down),
                (start[0] + second * across, start[1] + second * down),
                colour,
                width,
            )

    def _arrow(self, start: Point, end: Point, colour: Colour, width: float) -> None:
        across, down = end[0] - start[0], end[1] - start[1]
        length = math.hypot(across, down)
        if length < SHORTEST_ARROW * OVERSAMPLING:
            return
        across, down = across / length, down / length
        head = min(length, 11.0 * OVERSAMPLING)
        neck = (end[0] - head * across, end[1] - head * down)
        if length > head:
            self._line(start, neck, colour, width)
        wing = 0.5 * head
        corners = [
            end,
            (neck[0] - wing * down, neck[1] + wing * across),
            (neck[0] + wing * down, neck[1] - wing * across),
        ]
        self._pygame.draw.polygon(self._canvas, colour, corners)

    def _text(self, text: str, place: Point, colour: Colour, size: int, anchor: str) -> None:
        try:
            image = self._fonts[size].render(text, True, colour)
        except self._pygame.error:
            # Someone has closed pygame's fonts, as Gymnasium's environments do with all of it.
            self._make_fonts()
            image = self._fonts[size].render(text, True, colour)
        position: dict[str, Any] = {anchor: (round(place[0]), round(place[1]))}
        self._canvas.blit(image, image.get_rect(**position))
