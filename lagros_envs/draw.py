"""Drawing of any task whose body has a place in a plane, with pygame, imported when needed."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
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

if TYPE_CHECKING:
    from lagros_envs.task import Task

WIDTH, HEIGHT = 800, 500  # [px]
PANEL = 230  # width of the panel with the figures beside the plane [px]
MARGIN = 0.12  # kept around what is shown, as a share of it
SMALLEST_SPAN = 2.0  # width of the view where everything is close [m]
SMALLEST_BODY = 7  # radius at which a body is seen [px]
ARROW_LENGTH = 60  # of a disturbance as large as its bound [px]
PLOT_HEIGHT = 120  # of the plot of the distance over time [px]


@dataclass(frozen=True)
class Frame:
    """What a picture of an episode shows.

    Attributes:
        state: x, shape (n,).
        goal: x_f, shape (n,).
        discs: Centre and radius of each disc, shape (k, 3) [m].
        tube_radius: How near the goal counts as success now.
        disturbance: d of the last step, shape (n,).
        disturbance_bound: d_bar, the scale of the arrows.
        nominal: x_d at this time, shape (n,), drawn as a ghost; None without a plan.
        time: t [s].
    """

    state: FloatArray
    goal: FloatArray
    discs: FloatArray
    tube_radius: float
    disturbance: FloatArray
    disturbance_bound: float
    nominal: FloatArray | None
    time: float

    @property
    def share(self) -> FloatArray:
        """The disturbance as a share of its bound, shape (n,)."""
        bound = self.disturbance_bound
        return self.disturbance / bound if bound > 0.0 else np.zeros(len(self.state))


def rotor_outline(place: FloatArray, tilt: float, half: float) -> list[FloatArray]:
    """Return a rod with a rotor at each end, seen from the side, as three polygons [m].

    Args:
        place: Its middle, shape (2,) [m].
        tilt: Of the rod from the horizontal, to the left [rad].
        half: Half of its length [m].
    """
    along = np.array([math.cos(tilt), math.sin(tilt)])
    across = np.array([-along[1], along[0]])
    parts = [(-half, half, -0.02, 0.02), (-half, -0.05, 0.04, 0.06), (0.05, half, 0.04, 0.06)]
    return [
        np.stack(
            [
                place + x * along + y * across
                for x, y in ((left, low), (right, low), (right, high), (left, high))
            ]
        )
        for left, right, low, high in parts
    ]


class Renderer(Protocol):
    """What draws the environment of a task."""

    def draw(self, frame: Frame) -> NDArray[np.uint8] | None:
        """Draw one frame: (height, width, 3), or None in a window."""

    def close(self) -> None:
        """Close the window, if there is one."""


class PlaneRenderer(Canvas):
    """Draws body, goal, discs, nominal and disturbance in the plane, and the distance over time.

    The body is `task.outline`, or a disc with a mark where it is heading, as far as it moves. The
    view holds everything there is in the episode. A task without a place shows its coordinates as
    numbers, and the plot.

    Args:
        task: The task.
        render_mode: "human" or "rgb_array".
        fps: Frames per second at which "human" plays.

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(self, task: Task, render_mode: str, fps: int) -> None:
        super().__init__(render_mode, fps, (WIDTH, HEIGHT), task.env_id, (15, 17, 20))
        self._task = task
        # The frames of this episode, without arrays that others write to.
        self._history: list[Frame] = []

    def draw(self, frame: Frame) -> NDArray[np.uint8] | None:
        """Draw one frame.

        Returns:
            The frame, shape (500, 800, 3), in the mode "rgb_array"; None in the mode "human".
        """
        while self._history and self._history[-1].time >= frame.time:
            self._history.pop()  # a new episode, or a frame redrawn
        self._history.append(replace(frame, state=np.array(frame.state)))
        self._clear()
        if self._place(frame.state).size:
            self._look(frame)
            self._draw_plane(frame)
        panel = self._pygame.Rect(0, 0, PANEL * OVERSAMPLING, HEIGHT * OVERSAMPLING)
        self._canvas.fill((248, 248, 248), panel)
        self._draw_figures(frame)
        self._draw_plot(frame)
        return self._shown()

    # Coordinates: metres in the plane to pixels of the enlarged canvas.

    def _look(self, frame: Frame) -> None:
        """Choose a view that holds all of the episode so far, and its goal and discs."""
        places = [self._place(one.state) for one in self._history]
        places += [self._place(frame.goal)]
        places += [] if frame.nominal is None else [self._place(frame.nominal)]
        for corners in self._task.outline(frame.state):
            places += [*corners]
        low, high = np.min(places, axis=0), np.max(places, axis=0)
        for x, y, radius in frame.discs:
            low = np.minimum(low, (x - radius, y - radius))
            high = np.maximum(high, (x + radius, y + radius))
        span = np.maximum(high - low, SMALLEST_SPAN) + 2.0 * self._task.body_radius
        width, height = WIDTH - PANEL, HEIGHT
        self._scale = float(min((width, height) / ((1.0 + 2.0 * MARGIN) * span)))
        self._centre = 0.5 * (low + high)

    def _place(self, state: FloatArray) -> FloatArray:
        return self._task.place(state)

    def _point(self, place: FloatArray) -> Point:
        across, up = self._scale * (np.asarray(place) - self._centre)
        middle = PANEL + (WIDTH - PANEL) / 2
        return OVERSAMPLING * (middle + across), OVERSAMPLING * (HEIGHT / 2 - up)

    def _length(self, metres: float) -> float:
        return OVERSAMPLING * self._scale * metres

    # Parts of the scene, from the back to the front.

    def _draw_plane(self, frame: Frame) -> None:
        circle = self._pygame.draw.circle
        for x, y, radius in frame.discs:
            circle(self._canvas, PALE, self._point(np.array([x, y])), self._length(radius))
            circle(self._canvas, GREY, self._point(np.array([x, y])), self._length(radius), 2)
        goal = self._point(self._place(frame.goal))
        around = max(2.0, self._length(frame.tube_radius))
        # No circle that is many times as large as the canvas.
        if around < 4 * WIDTH * OVERSAMPLING:
            circle(self._canvas, SKY_BLUE, goal, around, 2 * OVERSAMPLING)
        for sign in (1, -1):
            half = 6 * OVERSAMPLING
            first = (goal[0] - half, goal[1] - sign * half)
            self._line(first, (goal[0] + half, goal[1] + sign * half), GREEN, 2.5)
        trail = [self._point(self._place(one.state)) for one in self._history]
        for start, end in itertools.pairwise(trail):
            self._line(start, end, mix(BLUE, 0.5), 2)
        if frame.nominal is not None:
            self._draw_body(frame.nominal, mix(PURPLE, 0.6), ghost=True)
        self._draw_body(frame.state, BLUE, ghost=False)
        places, rates = self._task.position, self._task.rates
        if places:
            self._draw_push(frame, frame.share[list(places[:2])], BLACK)
        if places and len(rates) == len(places):
            self._draw_push(frame, frame.share[list(rates[:2])], VERMILLION)

    def _draw_push(self, frame: Frame, share: FloatArray, colour: Colour) -> None:
        start = self._point(self._place(frame.state))
        reach = ARROW_LENGTH * OVERSAMPLING
        end = (start[0] + reach * float(share[0]), start[1] - reach * float(share[1]))
        self._arrow(start, end, colour, 3)

    def _draw_body(self, state: FloatArray, colour: Colour, ghost: bool) -> None:
        pygame, width = self._pygame, 2 * OVERSAMPLING if ghost else 0
        outline = self._task.outline(state)
        for corners in outline:
            points = [self._point(corner) for corner in corners]
            pygame.draw.polygon(self._canvas, colour, points, width)
        if outline:
            return
        centre = self._point(self._place(state))
        radius = max(SMALLEST_BODY * OVERSAMPLING, self._length(self._task.body_radius))
        pygame.draw.circle(self._canvas, colour, centre, radius, width)
        way = np.zeros(2) if ghost else self._heading()
        if way.any():
            nose = (centre[0] + radius * way[0], centre[1] - radius * way[1])
            self._line(centre, nose, BLACK, 3)

    def _heading(self) -> FloatArray:
        """Return the direction of the last move, a unit vector; zero at rest."""
        if len(self._history) < 2:
            return np.zeros(2)
        before, now = (self._place(one.state) for one in self._history[-2:])
        length = float(np.linalg.norm(now - before))
        way: FloatArray = (now - before) / length if length > 1e-9 else np.zeros(2)
        return way

    # The panel.

    def _draw_figures(self, frame: Frame) -> None:
        distance = self._distance(frame)
        relation = "≤" if distance <= frame.tube_radius else ">"
        names = self._task.state_names or [f"x{k}" for k in range(len(frame.state))]
        rows = [
            (self._task.title, BLACK),
            (f"t = {frame.time:.2f} s", BLACK),
            (f"distance = {distance:.2f} {relation} {frame.tube_radius:.2f}", BLACK),
            *(
                (f"{name} = {value:.3g}", GREY)
                for name, value in zip(names, frame.state, strict=True)
            ),
        ]
        if frame.disturbance_bound > 0.0:
            rows.append((f"||d|| = {np.linalg.norm(frame.disturbance):.2f}", VERMILLION))
        gap = min(22.0, (HEIGHT - PLOT_HEIGHT - 60) / len(rows))
        for index, (row, colour) in enumerate(rows):
            place = (14 * OVERSAMPLING, (20 + gap * index) * OVERSAMPLING)
            self._text(row.replace("-", "−"), place, colour, 20 if index < 3 else 17, "midleft")

    def _distance(self, frame: Frame) -> float:
        return float(self._task.goal_distance([*frame.state], [*frame.goal], np))

    def _draw_plot(self, frame: Frame) -> None:
        """Draw distance and radius over time, from the frames of the episode so far."""
        left, width = 14 * OVERSAMPLING, (PANEL - 28) * OVERSAMPLING
        top, height = (HEIGHT - PLOT_HEIGHT - 24) * OVERSAMPLING, PLOT_HEIGHT * OVERSAMPLING
        latest = max(self._task.time_limit, frame.time)
        rows = [(one.time, self._distance(one), one.tube_radius) for one in self._history]
        highest = 1.1 * max(1e-9, *(max(row[1:]) for row in rows))
        axes = [(left, top), (left, top + height), (left + width, top + height)]
        self._pygame.draw.lines(self._canvas, GREY, False, axes, OVERSAMPLING)
        for entry, colour in ((2, SKY_BLUE), (1, BLACK)):
            points = [
                (left + width * row[0] / latest, top + height * (1.0 - row[entry] / highest))
                for row in rows
            ]
            for start, end in itertools.pairwise(points):
                self._line(start, end, colour, 2)
            self._pygame.draw.circle(self._canvas, colour, points[-1], 3 * OVERSAMPLING)
        below = top + height + 10 * OVERSAMPLING
        self._text("distance, radius", (left, below), GREY, 15, "midleft")
        self._text(f"{latest:g} s", (left + width, below), GREY, 15, "midright")
