"""The network policies of the spacecraft, taken apart for `lagros export`."""

from __future__ import annotations

from functools import partial

import numpy as np

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.tasks.spacecraft.sensing import NEIGHBOUR_DIM, OBSTACLE_DIM
from lagros_envs.tasks.spacecraft.task import THRUSTERS
from lagros_policies.export.program import Bodies, Numbers, Part, Program, Vector
from lagros_policies.export.source import Exported, Source
from lagros_policies.tasks.spacecraft.features import NEIGHBOUR, body_features, own_features
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.thrusters import allocation_matrix

SpacecraftSource = Source  # its older name
_OWN = Part(
    "own",
    9,
    "what the agent knows of itself: goal relative to it x, y [m]; velocity x, y [m/s]; cos and "
    "sin of its heading; turn of the heading since the start [rad]; spin [rad/s]; time since the "
    "start of the episode [s]",
)
_NEIGHBOUR = Part(
    "neighbour",
    NEIGHBOUR_DIM,
    "position x, y [m] and velocity x, y [m/s] relative to the agent, in the world's axes",
)
_OBSTACLE = Part("obstacle", OBSTACLE_DIM, "centre x, y relative to the agent [m], radius [m]")
_THRUST = Part("thrust", THRUSTERS, "u >= 0 of the eight thrusters [N]; hold it for 0.1 s")


def exported(policy: SpacecraftNetworkPolicy) -> Exported:
    """Take a policy apart; one agent, from its own observation alone."""
    settings, preset, body = policy.settings, policy.preset, policy.settings.system
    reach, layers = settings.sensing_radius, policy.network.layers

    def look(own: Numbers) -> tuple[Numbers, Numbers]:
        goal, velocity = Vector(*own[0:2]), Vector(*own[2:4])
        left = settings.horizon - own[8]
        features, ahead = own_features(goal, velocity, own[6], own[7], left, policy.receding)
        return features, [ahead.real, ahead.imag, *own[2:6]]

    def neighbour(seen: Numbers, context: Numbers) -> tuple[Numbers, object]:
        back = Vector(*context[0:2]).conj()
        apart, motion = Vector(*seen[0:2]) * back, Vector(*seen[2:4]) * back
        features, weight = body_features(apart, motion, 2.0 * preset.agent_radius, reach)
        return features[: len(NEIGHBOUR)], weight

    def obstacle(seen: Numbers, context: Numbers) -> tuple[Numbers, object]:
        back = Vector(*context[0:2]).conj()
        apart, motion = Vector(*seen[0:2]) * back, -Vector(*context[2:4]) * back
        return body_features(apart, motion, seen[2] + preset.core, seen[2] + reach)

    def act(outputs: Numbers, context: Numbers) -> Numbers:
        push = Vector(*outputs[0:2]) * Vector(*context[0:2]) * Vector(*context[4:6])
        return [push.real * body.mass, push.imag * body.mass, outputs[2] * (2.0 * body.inertia)]

    layout = policy.layout
    program = Program(
        (_OWN,),
        look,
        layers["agent"],
        act,
        _THRUST,
        tanh=False,
        bodies=(
            Bodies(_NEIGHBOUR, layout.neighbours, neighbour, layers["neighbour"]),
            Bodies(_OBSTACLE, layout.obstacles, obstacle, layers["obstacle"]),
        ),
        last=allocation_matrix(body).astype(np.float32),
        notes=(
            f"Radii of an agent: {preset.agent_radius:g} m against others, {preset.core:g} m "
            f"against obstacles. Bodies that would not be sensed, farther than {reach:g} m, have "
            "no influence. No safety filter is included"
            + (", and no rule against deadlocks." if policy.receding else "."),
        ),
        metadata=(
            ("unit", "N"),
            ("neighbour_slots", str(layout.neighbours)),
            ("obstacle_slots", str(layout.obstacles)),
            ("agent_radius", str(preset.agent_radius)),
            ("core_radius", str(preset.core)),
        ),
    )
    return Exported(
        program,
        lambda observation: policy.thrust(observation).astype(np.float32),
        partial(example_sensed, policy),
    )


def example_sensed(policy: SpacecraftNetworkPolicy, count: int, seed: int = 0) -> Float32Array:
    """Return random observations of a spacecraft, shape (count, policy.layout.size).

    Goals lie up to 6 m away in any direction, velocities reach 0.5 m/s and spins 0.5 rad/s, times
    the end of the episode. Every slot is sensed by chance, with its body anywhere between a slight
    overlap and the rim of what is sensed; what is not sensed is zero, as in the environment.
    """
    rng = np.random.default_rng(seed)
    settings, preset, layout = policy.settings, policy.preset, policy.layout
    at, reach = layout.slices, settings.sensing_radius
    rows = np.zeros((count, layout.size), np.float32)
    rows[:, at["goal"]] = _around(rng, np.zeros(count), 6.0)
    rows[:, at["velocity"]] = _around(rng, np.zeros(count), 0.5)
    heading, turn = rng.uniform(-np.pi, np.pi, (2, count))
    rows[:, at["heading"]] = np.stack([np.cos(heading), np.sin(heading), turn], axis=1)
    rows[:, at["spin"]] = rng.uniform(-0.5, 0.5, (count, 1))
    rows[:, at["time"]] = rng.uniform(0.0, settings.time_limit, (count, 1))

    touch = np.full((count, layout.neighbours), 2.0 * preset.agent_radius)
    neighbours = [_around(rng, 0.9 * touch, reach), _around(rng, 0.0 * touch, 0.8)]
    radii = preset.obstacle_radius * rng.uniform(0.6, 1.4, (count, layout.obstacles))
    obstacles = [_around(rng, 0.9 * (radii + preset.core), reach + radii), radii[..., None]]
    for parts, name in ((neighbours, "neighbour"), (obstacles, "obstacle")):
        slots = np.concatenate(parts, axis=-1)
        sensed = rng.random(slots.shape[:2]) < 0.5
        rows[:, at[f"{name}_mask"]] = sensed
        rows[:, at[f"{name}s"]] = (slots * sensed[..., None]).reshape(count, -1)
    return rows


def _around(rng: np.random.Generator, least: FloatArray, most: FloatArray | float) -> FloatArray:
    """Return vectors of a length between two and of any direction, shape (*least.shape, 2)."""
    angle = rng.uniform(-np.pi, np.pi, least.shape)
    length = rng.uniform(least, most)
    return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
