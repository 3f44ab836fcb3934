"""The figure of one world: what every policy made of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lagros_benchmarks.report.canvas import LONGEST_LABEL, canvas, caption, check_figure_path
from lagros_benchmarks.report.canvas import save as write
from lagros_benchmarks.report.formats import policy_label
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.tasks.spacecraft.episodes import AgentRecord
from lagros_benchmarks.tasks.spacecraft.experiment import Scene, ScenePanel, fly_scene
from lagros_envs.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, without black and yellow.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_OBSTACLE, _OBSTACLE_RIM, _RED = "#C9C9C9", "#8C8C8C", "#B00020"
_BORDER = 0.6  # of the view around the arena and all goals [m]
_DISC_EVERY = 5.0  # time between the discs along a path [s]
_MOST_COLUMNS = 4


def draw_scene(settings: BenchmarkSettings, world: int, path: str | Path) -> Path:
    """Fly one world of a run again with every policy, and draw it; see `fly_scene`."""
    return scene_figure(fly_scene(settings, world, Toolbox()), path)


def scene_figure(scene: Scene, path: str | Path) -> Path:
    """Draw the trajectories of every policy in one world, a panel each.

    Agents are drawn as their discs every five seconds. A path is strong until the agent arrives or
    collides and faint after; a collision is a red cross on the agent's disc.
    """
    path = check_figure_path(path)
    columns = min(len(scene.panels), _MOST_COLUMNS)
    if len(scene.panels) == 4:
        columns = 2  # a square of panels shows more of each
    lines = -(-len(scene.panels) // columns)
    figure, axes = canvas(3.6 * columns, 3.9 * lines + 0.7, lines, columns)
    low, high = _view(scene)
    for panel, place in zip(scene.panels, axes, strict=False):
        _draw_world(place, scene)
        _draw_panel(place, scene, panel)
        place.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        place.set_title(_title(panel), loc="left", fontsize=9)
        place.grid(visible=False)
    for place in axes[len(scene.panels) :]:
        place.set_axis_off()
    for place in axes:
        place.tick_params(labelsize=8)
    for place in axes[max(0, len(scene.panels) - columns) : len(scene.panels)]:
        place.set_xlabel("x [m]", fontsize=9)
    for place in axes[: len(scene.panels) : columns]:
        place.set_ylabel("y [m]", fontsize=9)
    caption(
        figure,
        "circle: start; star in a ring: goal; disc: the agent every 5 s; faint: after arrival or "
        "collision\nred cross: collision; grey: obstacle; paths are cut at the frame",
    )
    first = scene.panels[0]
    condition, agents = first.case.condition, len(first.world.agents)
    filtered = "with" if first.case.safety_filter else "without"
    figure.suptitle(
        f"{agents} agent{'' if agents == 1 else 's'}, {condition.kind} disturbance, d̄ = "
        f"{condition.bound:g}, {filtered} the safety filter (seed {first.world.seed})\n",
        x=0.01,
        ha="left",
        fontsize=10,
    )
    return write(figure, path)


def _view(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the view: the arena, starts and goals, whatever left it."""
    points = np.concatenate(
        [
            np.zeros((1, 2)),
            np.full((1, 2), scene.arena),
            scene.scenario.starts,
            scene.scenario.goals,
        ]
    )
    return points.min(axis=0) - _BORDER, points.max(axis=0) + _BORDER


def _title(panel: ScenePanel) -> str:
    agents = panel.world.agents
    arrived = sum(agent.success for agent in agents)
    collided = sum(agent.collided for agent in agents)
    effort = sum(agent.effort for agent in agents) / len(agents)
    text = f"{policy_label(panel.case.policy, LONGEST_LABEL)}\n{arrived}/{len(agents)} arrived"
    if panel.world.error is not None:
        return f"{text}, raised an exception"
    if panel.world.planned is False:
        return f"{text}, no plan"
    return f"{text}, {collided} collided, effort {effort:.2f} N²s"


def _draw_world(axes: Axes, scene: Scene) -> None:
    from matplotlib.patches import Circle, Rectangle

    scenario = scene.scenario
    axes.add_patch(
        Rectangle((0, 0), scene.arena, scene.arena, fill=False, color="#DDDDDD", linewidth=0.8)
    )
    for centre, radius in zip(scenario.obstacles, scenario.obstacle_radii, strict=True):
        axes.add_patch(
            Circle(tuple(centre), radius, facecolor=_OBSTACLE, edgecolor=_OBSTACLE_RIM, lw=0.6)
        )
    for agent, (start, goal) in enumerate(zip(scenario.starts, scenario.goals, strict=True)):
        colour = _colour(agent)
        axes.add_patch(
            Circle(tuple(goal), scene.goal_radius, fill=False, edgecolor=colour, lw=1.0, ls=":")
        )
        axes.plot(*goal, marker="*", color=colour, markersize=9, markeredgecolor="white", zorder=4)
        axes.plot(*start, marker="o", color="white", markeredgecolor=colour, markersize=4, zorder=4)


def _draw_panel(axes: Axes, scene: Scene, panel: ScenePanel) -> None:
    from matplotlib.patches import Circle

    period, radius = scene.control_period, scene.scenario.agent_radius
    for index, agent in enumerate(panel.world.agents):
        colour = _colour(index)
        way = panel.path[:, index]
        end = _end_of_interest(agent, period, len(way))
        axes.plot(*way[: end + 1].T, color=colour, linewidth=1.4, zorder=3)
        axes.plot(*way[end:].T, color=colour, linewidth=0.7, alpha=0.35, zorder=2)
        every = max(1, round(_DISC_EVERY / period))
        for instant in range(0, end + 1, every):
            axes.add_patch(
                Circle(tuple(way[instant]), radius, facecolor=colour, alpha=0.12, linewidth=0)
            )
        axes.add_patch(
            Circle(tuple(way[end]), radius, facecolor=colour, edgecolor=colour, alpha=0.35, lw=0.8)
        )
        if agent.collision_time is not None:
            hit = way[min(round(agent.collision_time / period), len(way) - 1)]
            axes.add_patch(Circle(tuple(hit), radius, fill=False, edgecolor=_RED, lw=1.2, zorder=5))
            axes.plot(*hit, marker="x", color=_RED, markersize=8, markeredgewidth=2.0, zorder=6)


def _end_of_interest(agent: AgentRecord, period: float, instants: int) -> int:
    """Return the instant at which an agent arrives or collides, else the last one."""
    times = [time for time in (agent.success_time, agent.collision_time) if time is not None]
    time = min(times, default=math.inf)
    return instants - 1 if math.isinf(time) else min(round(time / period), instants - 1)


def _colour(agent: int) -> str:
    return _COLOURS[agent % len(_COLOURS)]
