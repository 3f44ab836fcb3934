"""Guesses for many agents by searches in space and time, one agent around those before it."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_policies.planning.grid_path import STEPS, Frame, GridSettings, frames_around


def search_in_turn(
    starts: FloatArray,
    goals: FloatArray,
    obstacles: FloatArray,
    distance: FloatArray,
    pair_distance: float,
    times: FloatArray,
    order: IntArray,
    settings: GridSettings,
) -> FloatArray:
    """Guess one agent after the other, each around those before it, by search in space and time.

    Dynamic programming over a coarse grid: least sum of squared steps, with a large price for
    coming too near. Being agents in priority order, the later ones give way.

    Args:
        starts: Positions, shape (n, 2) [m].
        goals: Positions, shape (n, 2) [m].
        obstacles: Centres, shape (m, 2) [m].
        distance: To be kept from each centre, shape (m,) [m].
        pair_distance: To be kept between agents [m].
        times: Instants of the guess, from 0, shape (k,) [s].
        order: The agents by priority, shape (n,).
        settings: The grid.

    Returns:
        Positions, shape (n, k, 2) [m].
    """
    duration = float(times[-1])
    most = settings.most_search_cells
    frames = frames_around(starts, goals, obstacles, settings.search_cell, settings.border, most)
    layers = max(2, round(duration / settings.search_period))
    instants = np.linspace(0.0, duration, layers + 1)
    found = np.zeros((len(starts), layers + 1, 2))
    standing: dict[Frame, FloatArray] = {}
    for turn, agent in enumerate(order):
        frame = frames[agent]
        centres = frame.centres()
        if frame not in standing:
            gaps = np.linalg.norm(centres[:, :, None] - obstacles, axis=-1) - distance
            # Half a cell of leave: the programs that follow polish the guess.
            least = np.min(gaps, axis=-1, initial=np.inf)
            standing[frame] = _price(least + 0.5 * frame.cell)
        prices = np.repeat(standing[frame][None], layers + 1, axis=0)
        for other in order[:turn]:
            apart = np.linalg.norm(centres - found[other][:, None, None], axis=-1)
            prices += _price(apart - pair_distance)
        source, target = frame.nearest(np.stack([starts[agent], goals[agent]]))
        cells = _cheapest_chain(prices, int(source), int(target))
        found[agent] = frame.origin + frame.cell * cells
        found[agent, 0], found[agent, -1] = starts[agent], goals[agent]
    return np.stack(
        [
            np.stack([np.interp(times, instants, found[agent, :, axis]) for axis in range(2)], -1)
            for agent in range(len(starts))
        ]
    )


def _price(room: FloatArray) -> FloatArray:
    """Return what standing at a distance beyond the required one costs, in squared cells."""
    value: FloatArray = np.where(room < 0.0, 100.0 - 100.0 * room, 0.0)
    return value


def _cheapest_chain(prices: FloatArray, source: int, target: int) -> IntArray:
    """Return the cells (layers, 2) from source to target of least squared steps plus prices."""
    layers, rows, columns = prices.shape
    value = np.full((rows, columns), np.inf)
    value.flat[source] = 0.0
    choice = np.zeros((layers, rows, columns), dtype=np.int8)
    for layer in range(1, layers):
        padded = np.pad(value, 2, constant_values=np.inf)
        options = np.stack(
            [
                padded[2 - i : 2 - i + rows, 2 - j : 2 - j + columns] + float(i * i + j * j)
                for i, j in STEPS
            ]
        )
        choice[layer] = np.argmin(options, axis=0)
        value = np.min(options, axis=0) + prices[layer]
    cell = np.array(np.unravel_index(target, (rows, columns)))
    if not np.isfinite(value[tuple(cell)]):
        # Too far for the steps of this grid: a straight line.
        begin = np.array(np.unravel_index(source, (rows, columns)))
        return np.rint(np.linspace(begin, cell, layers)).astype(np.intp)
    chain = [cell]
    for layer in range(layers - 1, 0, -1):
        cell = cell - np.array(STEPS[choice[(layer, *cell)]])
        chain.append(cell)
    return np.array(chain[::-1])
