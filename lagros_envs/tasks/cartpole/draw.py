"""Drawing of the cart-pole with pygame, which is imported when the first frame is asked for."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    OVERSAMPLING,
    PALE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    Canvas,
    Colour,
    Point,
    mix,
)
from lagros_envs.draw import Frame
from lagros_envs.tasks.cartpole.task import CART_SIZE, HINGE_HEIGHT

if TYPE_CHECKING:
    from lagros_envs.tasks.cartpole.task import CartPoleSettings

WIDTH, HEIGHT = 800, 400  # [px]
RAIL_HEIGHT = 352  # of the rail, from the top [px]
SMALLEST_SPAN = 7.0  # width of the view when cart and goal are close [m]
MARGIN = 1.5  # kept beside cart and goal [m] ...
MARGIN_PIXELS = 110  # ... and at least this, where an arrow fits [px]
TUBE_HEIGHT = 1.62  # of the band that shows it, above the rail [m]
ARROW_LENGTH = 80  # of a disturbance as large as its bound [px]
PLOT_DURATION = 9.0  # shown at least [s]
PLOT_HEIGHT = 3.5  # shown at least, in units of the state norm
PLOT = (262, 18, 240, 96)  # left, top, width, height of the plot over time [px]


class CartPoleRenderer(Canvas):
    """Draws the cart-pole, its goal, the tube and the disturbance.

    The view scrolls and zooms with cart and goal, so that both stay in it however far the cart
    travels. Only the mode "human" opens a window; "rgb_array" needs no display.

    Args:
        task: The task.
        render_mode: "human" or "rgb_array".
        fps: Frames per second at which "human" plays.

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(self, task: CartPoleSettings, render_mode: str, fps: int) -> None:
        super().__init__(render_mode, fps, (WIDTH, HEIGHT), task.env_id, (17, 20))
        self._half_length = task.system.half_length
        # (t, distance to the goal, radius) of the frames of this episode.
        self._history: list[tuple[float, float, float]] = []

    def draw(self, frame: Frame) -> NDArray[np.uint8] | None:
        """Draw one frame.

        Returns:
            The frame, shape (400, 800, 3), in the mode "rgb_array"; None in the mode "human".
        """
        state, goal, nominal, tube_radius = (
            frame.state,
            frame.goal,
            frame.nominal,
            frame.tube_radius,
        )
        half_length, time = self._half_length, frame.time
        left, right = sorted((float(state[0]), float(goal[0])))
        apart = right - left
        self._span = max(
            SMALLEST_SPAN,
            apart + 2.0 * MARGIN,
            apart * WIDTH / (WIDTH - 2.0 * MARGIN_PIXELS),
        )
        self._centre = 0.5 * (left + right)
        distance = float(np.linalg.norm(state - goal))
        self._clear()
        # The tube is a ball in the whole state. At the angle and rates of x it reaches so far in p.
        others = float(np.linalg.norm(state[1:] - goal[1:]))
        reach = math.sqrt(max(0.0, tube_radius**2 - others**2))
        self._draw_tube(float(goal[0]), tube_radius, reach)
        self._draw_rail()
        self._draw_cart_pole(goal, half_length, GREEN, ghost=True)
        if nominal is not None:
            self._draw_cart_pole(nominal, half_length, PURPLE, ghost=True)
        self._draw_cart_pole(state, half_length, BLUE, ghost=False)
        self._draw_disturbance(state, frame.share, half_length)
        bound = frame.disturbance_bound
        self._draw_legend(time, distance, tube_radius, bound, nominal is not None)
        self._draw_plot(time, distance, tube_radius)
        return self._shown()

    # Coordinates: metres along and above the rail to pixels of the enlarged canvas.

    def _point(self, along: float, above: float) -> Point:
        scale = self._scale()
        return (
            OVERSAMPLING * (WIDTH / 2 + scale * (along - self._centre)),
            OVERSAMPLING * (RAIL_HEIGHT - scale * above),
        )

    def _scale(self) -> float:
        """Pixels of the frame per metre."""
        return WIDTH / self._span

    # Parts of the scene, from the back to the front.

    def _draw_rail(self) -> None:
        start, end = self._point(self._centre - self._span, 0.0)[1], WIDTH * OVERSAMPLING
        self._line((0.0, start), (end, start), GREY, 3)
        spacing = _tick_spacing(self._span)
        first = math.ceil((self._centre - self._span / 2) / spacing)
        last = math.floor((self._centre + self._span / 2) / spacing)
        for tick in range(first, last + 1):
            along, above = self._point(tick * spacing, 0.0)
            self._line((along, above), (along, above + 7 * OVERSAMPLING), GREY, 2)
            label = f"{tick * spacing:g}".replace("-", "−")
            self._text(label, (along, above + 17 * OVERSAMPLING), GREY, 17, anchor="center")
        corner = ((WIDTH - 10) * OVERSAMPLING, start + 36 * OVERSAMPLING)
        self._text("p [m]", corner, GREY, 17, anchor="midright")

    def _draw_tube(self, goal: float, radius: float, reach: float) -> None:
        """Draw how far the tube reaches in p: at the goal's angle and rates, and at those of x."""
        if radius <= 0.0:
            return
        colour = SKY_BLUE
        low, high = self._point(goal - radius, 0.0), self._point(goal + radius, 0.0)
        top = round(self._point(0.0, TUBE_HEIGHT)[1])
        if reach > 0.0:
            left, right = self._point(goal - reach, 0.0)[0], self._point(goal + reach, 0.0)[0]
            rectangle = self._pygame.Rect(
                round(left), top, max(1, round(right - left)), round(low[1]) - top
            )
            self._canvas.fill(mix(colour, 0.3), rectangle)
        for edge in (low[0], high[0]):
            self._dashed((edge, top), (edge, low[1]), colour, 2)
        # The radius, as a dimension line from the goal.
        centre = self._point(goal, 0.0)[0]
        height = top + 12 * OVERSAMPLING
        if high[0] - centre > 40 * OVERSAMPLING:
            self._arrow((centre, height), (high[0], height), colour, 1.5)
            middle = (0.5 * (centre + high[0]), height + 11 * OVERSAMPLING)
            self._text("r(t)", middle, mix(BLACK, 0.75), 17, anchor="center")
        self._dashed((centre, top), (centre, low[1]), GREEN, 1.5)

    def _draw_cart_pole(
        self, state: FloatArray, half_length: float, colour: Colour, ghost: bool
    ) -> None:
        pygame, scale = self._pygame, self._scale() * OVERSAMPLING
        width, height = CART_SIZE[0] * scale, CART_SIZE[1] * scale
        wheel = 0.3 * height
        along, ground = self._point(float(state[0]), 0.0)
        hinge, tip = self._pole(state, half_length)
        body = pygame.Rect(0, 0, round(width), round(height))
        body.midbottom = (round(along), round(ground - wheel))
        if ghost:
            faded = mix(colour, 0.7)
            pygame.draw.rect(
                self._canvas, faded, body, width=2 * OVERSAMPLING, border_radius=round(height / 5)
            )
            self._dashed(hinge, tip, faded, 4)
            pygame.draw.circle(self._canvas, faded, tip, 4 * OVERSAMPLING)
            return
        for side in (-0.3, 0.3):
            centre = (along + side * width, ground - wheel)
            pygame.draw.circle(self._canvas, BLACK, centre, wheel)
            pygame.draw.circle(self._canvas, PALE, centre, 0.45 * wheel)
        pygame.draw.rect(self._canvas, colour, body, border_radius=round(height / 5))
        self._line(hinge, tip, ORANGE, max(3.0, 0.055 * self._scale()))
        pygame.draw.circle(self._canvas, BLACK, hinge, 0.045 * scale)

    def _pole(self, state: FloatArray, half_length: float) -> tuple[Point, Point]:
        """Return where hinge and tip of the pole are; a positive angle leans to the right."""
        above = HINGE_HEIGHT
        along, angle, length = float(state[0]), float(state[1]), 2.0 * half_length
        return (
            self._point(along, above),
            self._point(along + length * math.sin(angle), above + length * math.cos(angle)),
        )

    def _draw_disturbance(self, state: FloatArray, share: FloatArray, half_length: float) -> None:
        """Draw d as arrows: on the cart its first and third entry, on the pole the others."""
        scale = self._scale() * OVERSAMPLING
        reach = ARROW_LENGTH * OVERSAMPLING
        along, ground = self._point(float(state[0]), 0.0)
        for entry, height, colour in ((0, 0.32, BLACK), (2, 0.72, VERMILLION)):
            side = math.copysign(0.5 * CART_SIZE[0] * scale, share[entry])
            start = (along + side, ground - height * 1.3 * CART_SIZE[1] * scale)
            self._arrow(start, (start[0] + reach * share[entry], start[1]), colour, 3)
        hinge, tip = self._pole(state, half_length)
        # Across the pole, in the direction of growing angle.
        across = (math.cos(float(state[1])), math.sin(float(state[1])))
        for entry, place, colour in ((1, 0.62, BLACK), (3, 0.92, VERMILLION)):
            start = (
                hinge[0] + place * (tip[0] - hinge[0]),
                hinge[1] + place * (tip[1] - hinge[1]),
            )
            length = reach * float(share[entry])
            end = (start[0] + length * across[0], start[1] + length * across[1])
            self._arrow(start, end, colour, 3)

    def _draw_legend(
        self, time: float, distance: float, radius: float, bound: float, planned: bool
    ) -> None:
        inside = distance <= radius
        relation = "≤" if inside else ">"
        rows = [
            f"t = {time:.1f} s",
            f"||x − x_f|| = {distance:.2f}  {relation}  r(t) = {radius:.2f}",
        ]
        for index, row in enumerate(rows):
            place = (16 * OVERSAMPLING, (20 + 24 * index) * OVERSAMPLING)
            self._text(row, place, BLACK, 20, anchor="midleft")
        place = (16 * OVERSAMPLING, 68 * OVERSAMPLING)
        where, colour = ("inside the tube", BLUE) if inside else ("outside the tube", VERMILLION)
        self._text(where, place, colour, 20, anchor="midleft")
        keys: list[tuple[str, Colour, str]] = [
            ("ghost", GREEN, "goal x_f"),
            ("edge", SKY_BLUE, "tube ||x − x_f|| ≤ r(t)"),
            ("box", SKY_BLUE, "p in the tube at this θ, rates"),
        ]
        if planned:
            keys.append(("ghost", PURPLE, "nominal x_d"))
        if bound > 0.0:
            keys.append(("arrow", BLACK, "disturbance of p, θ"))
            keys.append(("arrow", VERMILLION, "disturbance of their rates"))
        for index, (shape, colour, label) in enumerate(keys):
            self._legend_key(shape, colour, label, 20 + 20 * index)

    def _legend_key(self, shape: str, colour: Colour, label: str, height: float) -> None:
        left, right = 580 * OVERSAMPLING, 612 * OVERSAMPLING
        level = height * OVERSAMPLING
        if shape == "ghost":
            self._dashed((left, level), (right, level), mix(colour, 0.7), 4)
        elif shape == "edge":
            self._dashed((left, level), (right, level), colour, 2)
        elif shape == "arrow":
            self._arrow((left, level), (right, level), colour, 3)
        else:
            box = self._pygame.Rect(
                left, round(level - 6 * OVERSAMPLING), right - left, 12 * OVERSAMPLING
            )
            self._canvas.fill(mix(colour, 0.3), box)
        self._text(label, (right + 10 * OVERSAMPLING, level), BLACK, 17, anchor="midleft")

    def _draw_plot(self, time: float, distance: float, radius: float) -> None:
        """Draw distance and radius over time, from the frames of the episode so far."""
        while self._history and self._history[-1][0] >= time:  # a new episode, or a frame redrawn
            self._history.pop()
        self._history.append((time, distance, radius))
        left, top, width, height = (OVERSAMPLING * part for part in PLOT)
        latest = max(PLOT_DURATION, time)
        highest = 1.1 * max(PLOT_HEIGHT, *(entry[1] for entry in self._history))

        def place(when: float, value: float) -> Point:
            return left + width * when / latest, top + height * (1.0 - value / highest)

        axes = [(left, top), (left, top + height), (left + width, top + height)]
        self._pygame.draw.lines(self._canvas, GREY, False, axes, OVERSAMPLING)
        curves = ((2, SKY_BLUE, "r(t)"), (1, BLACK, "||x − x_f||"))
        gap = 13 * OVERSAMPLING
        # The labels lie beside the ends of the curves, but not over each other or the axis.
        upper = place(time, max(radius, distance))[1]
        lower = max(place(time, min(radius, distance))[1], upper + gap)
        lower = min(lower, top + height - 0.6 * gap)
        upper = min(upper, lower - gap)
        levels = (upper, lower) if radius > distance else (lower, upper)
        for (entry, colour, name), level in zip(curves, levels, strict=True):
            points = [place(row[0], row[entry]) for row in self._history]
            for start, end in itertools.pairwise(points):
                self._line(start, end, colour, 2)
            self._pygame.draw.circle(self._canvas, colour, points[-1], 3.5 * OVERSAMPLING)
            beside = (points[-1][0] + 8 * OVERSAMPLING, level)
            self._text(name, beside, mix(BLACK, 0.75), 17, anchor="midleft")
        below = top + height + 9 * OVERSAMPLING
        self._text("0", (left, below), GREY, 17, anchor="center")
        self._text(f"{latest:g} s", (left + width, below), GREY, 17, anchor="center")
        label = left - 6 * OVERSAMPLING
        self._text(f"{highest:.1f}", (label, top + 4 * OVERSAMPLING), GREY, 17, anchor="midright")


def _tick_spacing(span: float) -> float:
    """Return 1, 2 or 5 times a power of ten, so that at most about 15 ticks are seen [m]."""
    spacing = 1.0
    while span / spacing > 15.0:
        # 1, 2, 5, 10, 20, 50, ...
        leading = spacing / 10.0 ** math.floor(math.log10(spacing))
        spacing *= 2.5 if round(leading) == 2 else 2.0
    return spacing
