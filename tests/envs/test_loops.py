"""What numba compiles of a world of spacecraft against what NumPy computes, bit for bit."""

import importlib.util

import numpy as np
import pytest

from lagros_envs.sweep import Path, swept_agents, swept_obstacles
from lagros_envs.tasks.spacecraft.loops import touched
from lagros_envs.tasks.spacecraft.nearby import Nearby
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.sensing import observe
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="numba is not installed"
)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("by_cells", [False, True])
def test_who_touches_whom_is_what_arrays_tell(seed, by_cells):
    rng = np.random.default_rng(seed)
    worlds, agents, discs = 3, 30, (0, 15)[seed % 5 > 0]
    speed = [0.0, 0.02, 0.3, 3.0][seed % 4]
    starts = rng.uniform(0.0, 8.0, (2, worlds, agents))
    centres = rng.uniform(0.0, 8.0, (2, worlds, discs))
    radii = rng.uniform(0.2, 0.7, (worlds, discs))
    radii[rng.random(radii.shape) < 0.2] = -np.inf
    points = starts + np.cumsum(speed * rng.normal(size=(3, 2, worlds, agents)), axis=0)
    path = Path.through(points, 0.01 * rng.random((worlds, agents)))
    contact, core = rng.uniform(0.1, 0.5, worlds), rng.uniform(0.0, 0.3, worlds)
    touch = radii + core[:, None]
    nearby = Nearby(2.0, starts, starts, contact, centres, radii, core, by_cells)
    near = nearby.at(points[-1], float(path.reach.max()))
    expected = swept_agents(path, contact)
    if discs:
        expected = expected | swept_obstacles(path, centres, touch)
    np.testing.assert_array_equal(touched(path, contact, centres, touch, near), expected)


SIZES = [(preset, agents) for preset in PRESETS for agents in (1, 2, 6)]
SIZES += [("swarm", 150), ("swarm-45", 150), ("gcbf", 150), ("gcbf-free", 150)]


@pytest.mark.parametrize(("preset", "agents"), SIZES)
def test_what_is_sensed_is_what_arrays_tell(preset, agents):
    worlds = 2
    env = SpacecraftVectorEnv(worlds * agents, agents, preset, "uniform", compiled=True)
    env.reset(seed=agents)
    rng = np.random.default_rng(agents)
    world = env.world
    for gather in (1.0, 0.9, 0.3, 0.02):  # in the end more are sensed than there are slots for
        world.parts[:2] *= gather
        world.parts[3:5] = rng.normal(size=world.parts[3:5].shape)
        compiled = observe(world, env.layout)
        world.compiled = False
        np.testing.assert_array_equal(compiled, observe(world, env.layout))
        world.compiled = True
    if agents == 150:
        mask = compiled[..., env.layout.slices["neighbour_mask"]]
        assert mask.all()
