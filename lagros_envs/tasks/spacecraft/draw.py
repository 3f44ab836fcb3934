"""Drawing of a spacecraft world with pygame, imported when the first frame is asked for."""

from __future__ import annotations

import itertools
import math
from typing import Any

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
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    WHITE,
    Canvas,
    Colour,
    Point,
    mix,
)
from lagros_envs.tasks.spacecraft.world import SpacecraftWorld

VIEW = 640  # side of the scene [px]
PANEL = 200  # width of the legend beside it [px]
BORDER = 0.6  # kept around the scenario [m]
YELLOW: Colour = (240, 228, 66)
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY_BLUE, YELLOW)
BODY = 0.62  # half the side of the body, as a share of the agent's radius
PLUME = 1.7  # length of a plume at the thrust scale, as a share of the agent's radius
CROWD = 64  # more agents than this are drawn as discs, goals as points, with trails that fade
TAIL = 4  # frames of a crowd's trails
TUBE_PERIOD = 0.5  # from disc to disc of a planned tube [s]
# For each thruster, in the body's axes and in units of half the body: where it sits, and where its
# plume points. The plume leaves against the force.
THRUSTERS = (
    ((1.0, 0.7), (1.0, 0.0)),
    ((1.0, -0.7), (1.0, 0.0)),
    ((-0.7, 1.0), (0.0, 1.0)),
    ((0.7, 1.0), (0.0, 1.0)),
    ((-1.0, -0.7), (-1.0, 0.0)),
    ((-1.0, 0.7), (-1.0, 0.0)),
    ((0.7, -1.0), (0.0, -1.0)),
    ((-0.7, -1.0), (0.0, -1.0)),
)


class SpacecraftRenderer(Canvas):
    """Draws the first world: arena, obstacles, goals, tubes, agents, thrusters and collisions.

    The view holds arena and scenario, and widens for agents that leave it. Only the mode "human"
    opens a window; "rgb_array" needs no display.

    Args:
        render_mode: "human" or "rgb_array".
        fps: Frames per second at which "human" plays.
        arena: Side of the arena [m].

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(self, render_mode: str, fps: int, arena: float) -> None:
        size = (VIEW + PANEL, VIEW)
        super().__init__(render_mode, fps, size, "lagros/Spacecraft-v0", (15, 17, 20))
        self._arena = arena
        # (t, positions) of the frames of this episode.
        self._trail: list[tuple[float, FloatArray]] = []
        self._low, self._side = np.zeros(2), arena

    def draw(self, world: SpacecraftWorld) -> NDArray[np.uint8] | None:
        """Draw one frame of the first world.

        Returns:
            The frame, shape (640, 840, 3), in the mode "rgb_array"; None in the mode "human".
        """
        time = float(world.time[0])
        positions = world.parts[:2, 0].T.copy()
        while self._trail and self._trail[-1][0] >= time:  # a new episode, or a frame redrawn
            self._trail.pop()
        self._trail.append((time, positions))
        self._fit(world)
        self._clear()
        self._draw_arena()
        if world.agents > CROWD:
            self._draw_crowd(world)
            self._draw_panel(world, time)
            return self._shown()
        self._draw_sensing(world)
        self._draw_planned_tubes(world)
        self._draw_obstacles(world)
        self._draw_goals(world)
        self._draw_trails()
        for agent in range(world.agents):
            self._draw_agent(world, agent)
        self._draw_nominal(world)
        self._draw_panel(world, time)
        return self._shown()

    # Coordinates: metres to pixels of the enlarged canvas.

    def _fit(self, world: SpacecraftWorld) -> None:
        count = len(self._trail)
        goals = world.goals[:, 0].T
        corners = [np.zeros((1, 2)), np.full((1, 2), self._arena), goals]
        # All that was seen so far, so that the view does not jump back and forth.
        corners += [self._trail[index][1] for index in range(0, count, max(1, count // 64))]
        corners.append(self._trail[-1][1])
        points = np.concatenate(corners)
        low, high = points.min(axis=0) - BORDER, points.max(axis=0) + BORDER
        self._side = float(np.max(high - low))
        self._low = 0.5 * (low + high) - 0.5 * self._side

    @property
    def _scale(self) -> float:
        """Pixels of the enlarged canvas per metre."""
        return VIEW * OVERSAMPLING / self._side

    def _point(self, place: Any) -> Point:
        across, up = (np.asarray(place) - self._low) * self._scale
        return float(across), float(VIEW * OVERSAMPLING - up)

    # Parts of the scene, from the back to the front.

    def _draw_arena(self) -> None:
        left, bottom = self._point((0.0, 0.0))
        right, top = self._point((self._arena, self._arena))
        area = self._pygame.Rect(round(left), round(top), round(right - left), round(bottom - top))
        self._canvas.fill((248, 248, 248), area)
        self._pygame.draw.rect(self._canvas, mix(GREY, 0.5), area, 2)

    def _draw_crowd(self, world: SpacecraftWorld) -> None:
        """Draw many agents: where they are, were and go, who has arrived and who collided."""
        self._draw_obstacles(world)
        draw, canvas = self._pygame.draw, self._canvas
        size = max(2.0, float(world.agent_radius[0]) * self._scale)
        arrived, collided = np.isfinite(world.success_time[0]), world.collided[0]
        for agent, goal in enumerate(self._points(world.goals[:, 0])):
            if not arrived[agent]:
                draw.circle(canvas, mix(BLUE, 0.3), goal, 0.4 * size)
        tails = [self._points(places.T) for _, places in self._trail[-TAIL:]]
        if len(tails) > 1:
            for agent, tail in enumerate(zip(*tails, strict=True)):
                if not arrived[agent]:
                    draw.lines(canvas, mix(BLUE, 0.5), False, tail, OVERSAMPLING)
        # What has happened to them: of so many, nobody follows one by its colour.
        for agent, place in enumerate(self._points(world.parts[:2, 0])):
            colour = VERMILLION if collided[agent] else GREEN if arrived[agent] else BLUE
            draw.circle(canvas, colour, place, size)

    def _points(self, places: FloatArray) -> list[Point]:
        """Return where places (2, n) are on the canvas."""
        across, up = (places - self._low[:, None]) * self._scale
        return list(zip(across.tolist(), (VIEW * OVERSAMPLING - up).tolist(), strict=True))

    def _draw_obstacles(self, world: SpacecraftWorld) -> None:
        for centre, radius in zip(
            world.obstacle_centres[:, 0].T, world.obstacle_radii[0], strict=True
        ):
            if math.isfinite(radius):
                self._disc(centre, radius, mix(GREY, 0.75))

    def _draw_sensing(self, world: SpacecraftWorld) -> None:
        for agent, place in enumerate(world.parts[:2, 0].T):
            self._dashed_ring(place, world.settings.sensing_radius, mix(self._colour(agent), 0.4))

    def _draw_planned_tubes(self, world: SpacecraftWorld) -> None:
        """Draw what is left of the plans x_d, as wide as the published tube."""
        if world.nominal is None:
            return
        settings = world.settings
        stride = max(1, round(TUBE_PERIOD / settings.control_period))
        steps = np.arange(int(world.step_count[0]), settings.steps + 1, stride)
        radii = settings.tube.radius(steps * settings.control_period)
        paths = world.nominal[0, steps, :, :2]
        for agent in range(world.agents):
            # A place where the plan waits is drawn once.
            moves = np.linalg.norm(np.diff(paths[:, agent], axis=0), axis=1) > 1e-3
            kept = np.append(moves, True)
            for place, radius in zip(paths[kept, agent], radii[kept], strict=True):
                self._disc(place, float(radius), mix(self._colour(agent), 0.2))
        for agent in range(world.agents):
            points = [self._point(place) for place in paths[:, agent]]
            if len(points) > 1:
                colour = mix(self._colour(agent), 0.45)
                self._pygame.draw.lines(self._canvas, colour, False, points, OVERSAMPLING)

    def _draw_goals(self, world: SpacecraftWorld) -> None:
        settings = world.settings
        arrived = np.isfinite(world.success_time[0])
        tube = float(settings.tube.radius(float(world.time[0])))
        for agent, goal in enumerate(world.goals[:, 0].T):
            colour = self._colour(agent)
            self._disc(goal, settings.goal_radius, mix(colour, 0.6 if arrived[agent] else 0.25))
            self._ring(goal, settings.goal_radius, colour, 1.5)
            self._ring(goal, tube, mix(BLACK, 0.6), 1.0)
            self._cross(goal, 0.35 * settings.goal_radius, colour, 2.0)
            label = goal + np.array([-1.0, 1.0]) * settings.goal_radius
            self._text(str(agent), self._point(label), mix(BLACK, 0.6), 15, anchor="center")

    def _draw_nominal(self, world: SpacecraftWorld) -> None:
        """Draw where the plans are now, and the tube around them, over the agents."""
        nominal = world.nominal_now()
        if nominal is None:
            return
        tube = float(world.settings.tube.radius(float(world.time[0])))
        for place in nominal[0, :, :2]:
            self._disc(place, 0.14 * float(world.agent_radius[0]), BLACK)
            self._ring(place, tube, BLACK, 1.0)

    def _draw_trails(self) -> None:
        if len(self._trail) < 2:
            return
        paths = np.array([positions for _, positions in self._trail])
        for agent in range(paths.shape[1]):
            points = [self._point(place) for place in paths[:, agent]]
            colour = mix(self._colour(agent), 0.6)
            self._pygame.draw.lines(self._canvas, colour, False, points, 2 * OVERSAMPLING)

    def _draw_agent(self, world: SpacecraftWorld, agent: int) -> None:
        x, y, heading = world.parts[:3, 0, agent]
        centre = np.array([x, y])
        colour = self._colour(agent)
        radius = float(world.agent_radius[0])
        first = np.array([math.cos(heading), -math.sin(heading)])
        second = np.array([math.sin(heading), math.cos(heading)])
        self._disc(centre, radius, mix(colour, 0.25))
        # An agent hides the goal it sits on, so that its own rim says that it has arrived.
        arrived = bool(np.isfinite(world.success_time[0, agent]))
        self._ring(centre, radius, BLACK if arrived else mix(colour, 0.7), 2.0 if arrived else 1.0)
        half = BODY * radius
        self._draw_plumes(world, agent, centre, half * first, half * second)
        corners = [centre + half * (a * first + b * second) for a, b in _SQUARE]
        self._polygon(corners, colour)
        # The nose lies on the first axis.
        nose = [half * (0.95 * first), half * (0.35 * first + 0.5 * second)]
        nose.append(half * (0.35 * first - 0.5 * second))
        self._polygon([centre + corner for corner in nose], WHITE)
        if world.collided[0, agent]:
            self._ring(centre, 1.08 * radius, VERMILLION, 3.0)
            self._cross(centre, radius, VERMILLION, 2.0)
        self._text(str(agent), self._point(centre + 0.95 * radius), BLACK, 17, anchor="center")

    def _draw_plumes(
        self,
        world: SpacecraftWorld,
        agent: int,
        centre: FloatArray,
        first: FloatArray,
        second: FloatArray,
    ) -> None:
        shares = world.forces[:, 0, agent] / world.settings.thrust_scale
        for share, (seat, way) in zip(shares, THRUSTERS, strict=True):
            if share < 0.01:
                continue
            base = centre + seat[0] * first + seat[1] * second
            outward = way[0] * first + way[1] * second
            aside = 0.2 * (way[1] * first + way[0] * second)
            # A square root shows the small thrusts, too; a huge one stays in the picture.
            reach = PLUME / BODY * math.sqrt(min(1.5, float(share)))
            self._polygon([base - aside, base + aside, base + reach * outward], VERMILLION)

    def _draw_panel(self, world: SpacecraftWorld, time: float) -> None:
        left = VIEW * OVERSAMPLING
        area = self._pygame.Rect(left, 0, PANEL * OVERSAMPLING, VIEW * OVERSAMPLING)
        self._canvas.fill((240, 240, 240), area)
        arrived = int(np.isfinite(world.success_time[0]).sum())
        collided = int(world.collided[0].sum())
        rows = [
            f"t = {time:.1f} s",
            f"arrived {arrived} of {world.agents}",
            f"collided {collided} of {world.agents}",
            f"effort {world.effort[0].sum():.2f} N²s",
        ]
        if world.disturbance.kind != "none":
            rows.append(f"disturbance ≤ {world.disturbance.bound:g}")
        for index, row in enumerate(rows):
            place = (left + 16 * OVERSAMPLING, (26 + 26 * index) * OVERSAMPLING)
            colour = VERMILLION if index == 2 and collided else BLACK
            self._text(row, place, colour, 20, anchor="midleft")
        keys = [
            ("disc", mix(BLUE, 0.25), "goal"),
            ("rim", mix(BLUE, 0.25), "arrived"),
            ("ring", mix(BLACK, 0.6), "tube r(t)"),
            ("dashed", mix(BLUE, 0.4), "sensing radius"),
            ("plume", VERMILLION, "thruster firing"),
            ("cross", VERMILLION, "collided"),
            ("disc", mix(GREY, 0.75), "obstacle"),
        ]
        if world.agents > CROWD:
            keys = [
                ("disc", mix(BLUE, 0.3), "goal"),
                ("disc", BLUE, "on its way"),
                ("disc", GREEN, "arrived"),
                ("disc", VERMILLION, "collided"),
                ("disc", mix(GREY, 0.75), "obstacle"),
            ]
        elif world.nominal is not None:
            keys.append(("tube", mix(BLUE, 0.2), "plan x_d in its tube"))
        for index, (shape, colour, label) in enumerate(keys):
            level = (200 + 26 * index) * OVERSAMPLING
            self._draw_key(shape, colour, label, left + 28 * OVERSAMPLING, level)
        start = (left + 16 * OVERSAMPLING, (VIEW - 24) * OVERSAMPLING)
        length = 1.0 if self._side < 30.0 else 10.0
        end = (start[0] + length * self._scale, start[1])
        self._pygame.draw.line(self._canvas, GREY, start, end, 2 * OVERSAMPLING)
        beside = (end[0] + 8 * OVERSAMPLING, start[1])
        self._text(f"{length:g} m", beside, GREY, 17, anchor="midleft")

    def _draw_key(self, shape: str, colour: Colour, label: str, across: int, level: int) -> None:
        pygame, unit = self._pygame, OVERSAMPLING
        centre = (across, level)
        if shape == "disc":
            pygame.draw.circle(self._canvas, colour, centre, 9 * unit)
        elif shape in ("rim", "tube"):
            pygame.draw.circle(self._canvas, colour, centre, 9 * unit)
            pygame.draw.circle(self._canvas, BLACK, centre, 9 * unit, 4 if shape == "rim" else 2)
            if shape == "tube":
                pygame.draw.circle(self._canvas, BLACK, centre, 3 * unit)
        elif shape == "ring":
            pygame.draw.circle(self._canvas, colour, centre, 9 * unit, 2)
        elif shape == "dashed":
            self._arcs(centre, 9.0 * unit, colour, 8)
        elif shape == "plume":
            corners = [(across - 4 * unit, level + 7 * unit), (across + 4 * unit, level + 7 * unit)]
            pygame.draw.polygon(self._canvas, colour, [*corners, (across, level - 8 * unit)])
        else:
            for side in (-1, 1):
                start = (across - 7 * unit, level - side * 7 * unit)
                end = (across + 7 * unit, level + side * 7 * unit)
                pygame.draw.line(self._canvas, colour, start, end, 3 * unit)
        place = (across + 20 * unit, level)
        self._text(label, place, BLACK, 17, anchor="midleft")

    # Strokes, in metres.

    def _colour(self, agent: int) -> Colour:
        return COLOURS[agent % len(COLOURS)]

    def _disc(self, centre: Any, radius: float, colour: Colour) -> None:
        size = max(1.0, radius * self._scale)
        self._pygame.draw.circle(self._canvas, colour, self._point(centre), size)

    def _ring(self, centre: Any, radius: float, colour: Colour, width: float) -> None:
        size = radius * self._scale
        if size >= 1.0:
            stroke = max(1, round(width * OVERSAMPLING))
            self._pygame.draw.circle(self._canvas, colour, self._point(centre), size, stroke)

    def _dashed_ring(self, centre: Any, radius: float, colour: Colour) -> None:
        if radius > 0.0:
            self._arcs(self._point(centre), radius * self._scale, colour, 48)

    def _arcs(self, centre: Point, size: float, colour: Colour, dashes: int) -> None:
        for dash in range(dashes):
            angles = [2.0 * math.pi * (dash + share) / dashes for share in (0.0, 0.25, 0.5)]
            points = [
                (centre[0] + size * math.cos(angle), centre[1] + size * math.sin(angle))
                for angle in angles
            ]
            for start, end in itertools.pairwise(points):
                self._pygame.draw.line(self._canvas, colour, start, end, OVERSAMPLING)

    def _cross(self, centre: FloatArray, arm: float, colour: Colour, width: float) -> None:
        for way in ((1.0, 1.0), (1.0, -1.0)):
            offset = arm * np.array(way) / math.sqrt(2.0)
            start, end = self._point(centre - offset), self._point(centre + offset)
            stroke = max(1, round(width * OVERSAMPLING))
            self._pygame.draw.line(self._canvas, colour, start, end, stroke)

    def _polygon(self, corners: list[FloatArray], colour: Colour) -> None:
        self._pygame.draw.polygon(self._canvas, colour, [self._point(place) for place in corners])


_SQUARE = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))
