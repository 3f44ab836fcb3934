"""The filter with a proof: nobody meets, whatever pushes them, and its constants hold."""

import dataclasses

import numpy as np
import pytest

from lagros_envs.balls import onto_unit_sphere
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Preset
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy
from lagros_policies.safety.reserve import zones_beside_bodies
from lagros_policies.tasks.spacecraft import proved_filter, reserved
from lagros_policies.tasks.spacecraft.proved_filter import ProvedFilter
from lagros_policies.tasks.spacecraft.reserved import (
    ReserveSettings,
    double_pole,
    largest_bound,
    reserved_for,
)
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate, held_thrust, to_body
from tests.policies.segments import segment_distance

TASK, PAPER, BOUND = SpacecraftSettings(), PRESETS["paper"], 0.4
# So dense that nobody gets out of anybody's way.
CROWD = Preset(agents=9, arena=2.6, obstacle_count=(0, 0), least_way=0.0)
TRIPLE = Preset(agents=3, arena=1.6, obstacle_count=(0, 0), least_way=0.0)
PAIR = Preset(agents=2, arena=1.2, obstacle_count=(0, 0), least_way=0.0)
PLACES = Preset(agents=5, arena=4.0, obstacle_count=(3, 3))


class Rush(BasePolicy):
    """All fly to one place at full speed, and turn about."""

    name = "rush"

    def __init__(self, env, noise=0.0):
        self.env, self.rng, self.noise = env, np.random.default_rng(1), noise
        self.layout = Layout.for_preset(env.preset, env.settings)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        sensed = Sensed.of(self.layout, observation)
        way = 0.5 * self.env.preset.arena - self.env.states[..., :2].reshape(-1, 2)
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        push = 5.0 * (way / np.maximum(distance, 0.2) - sensed.velocity)
        push += self.noise * self.rng.standard_normal(push.shape)
        torque = 3.0 * self.rng.standard_normal((len(push), 1)) - sensed.spin[:, None]
        force = to_body(push, sensed.heading)
        thrust = allocate(TASK.system, np.concatenate([force, torque], axis=1))
        return thrust.astype(np.float32), None


class Pusher:
    """Pushes at the bound: towards the nearest agent, about it, at random, or all one way.

    What it pushes changes its sign every few steps, or never.
    """

    def __init__(self, kinds, turn, every, seed=0):
        self.kinds, self.turn, self.every = np.asarray(kinds), np.asarray(turn), every
        self.rng, self.calls = np.random.default_rng(seed), 0

    def __call__(self, situation):
        state = situation.state
        place = state[..., :2] + 0.3 * state[..., 3:5]
        apart = place[:, None] - place[:, :, None]
        far = np.sum(apart * apart, axis=-1) + 1e9 * np.eye(place.shape[1])
        index = np.argmin(far, axis=2)[..., None, None]
        towards = np.take_along_axis(apart, index, axis=2)[:, :, 0]
        middle = place.mean(axis=1, keepdims=True) - place
        across = np.stack([-towards[..., 1], towards[..., 0]], axis=-1)
        steady = np.broadcast_to([1.0, 0.3], towards.shape)
        options = np.stack(
            [towards, across, middle, self.rng.standard_normal(towards.shape), steady, -towards]
        )
        way = options[self.kinds, np.arange(len(state))]
        way = onto_unit_sphere(way, np.array([1.0, 0.0]))
        sign = 1.0 if not self.every or self.calls // self.every % 2 == 0 else -1.0
        self.calls += 1
        push = np.zeros(state.shape)
        turn = self.turn[:, None, None]
        push[..., :2], push[..., 3:5] = sign * np.cos(turn) * way, sign * np.sin(turn) * way
        # Part of it turns the bodies.
        push[..., [2, 5]] = 0.3 * self.rng.standard_normal((*state.shape[:2], 2))
        return push


def worlds(preset, disturbance, count, settings=None):
    return SpacecraftVectorEnv(
        count * preset.agents,
        preset.agents,
        preset,
        disturbance,
        BOUND,
        settings=settings,
        autoreset_mode="disabled",
    )


def flown(preset, filtered, disturbance, count, steps, settings=None):
    """Fly and return the least gap of every world, at the control instants, and the state."""
    env = worlds(preset, disturbance, count, settings)
    wearing = filtered(Rush(env))
    observation, info = env.reset(seed=list(range(count)))
    state, gap = None, np.full(count, np.inf)
    touched = np.zeros(count * preset.agents, bool)
    for _ in range(steps):
        action, state = wearing.predict(observation, state)
        observation, *_, info = env.step(action)
        touched |= info["collided"]
        place = env.states[..., :2].reshape(count, -1, 2)
        far = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
        far += 1e9 * np.eye(preset.agents)
        gap = np.minimum(gap, far.min(axis=(1, 2)) - 2.0 * preset.agent_radius)
    return gap, touched.reshape(count, -1).any(axis=1), wearing.counters(state)


def proved(preset, **changes):
    """Return what puts the filter on a policy, with some of its constants changed."""

    def put_on(policy):
        wearing = ProvedFilter(policy, TASK, preset, disturbance_bound=BOUND)
        own = wearing.reserved
        reserve = dataclasses.replace(
            own.reserve, **{k: v for k, v in changes.items() if hasattr(own.reserve, k)}
        )
        rest = {k: v for k, v in changes.items() if not hasattr(own.reserve, k)}
        wearing.reserved = dataclasses.replace(own, reserve=reserve, **rest)
        return wearing

    return put_on


KINDS, TURNS = np.divmod(np.arange(12), 2)


def bangs(every=0):
    return Pusher(KINDS, np.where(TURNS == 0, 0.3, 1.3), every)


@pytest.mark.parametrize("every", [0, 3])
@pytest.mark.parametrize("preset", [PAIR, TRIPLE, CROWD, PLACES], ids=["2", "3", "9", "discs"])
def test_nobody_meets_whatever_pushes_them(preset, every):
    """All crowd to one place, pushed at the bound."""
    gap, touched, counts = flown(preset, proved(preset), bangs(every), 12, 100)
    assert not touched.any()
    assert counts["infeasible"] == 0
    assert gap.min() > 0.0
    assert counts["interventions"] > 100


def test_the_state_stays_in_the_set_that_the_theorem_is_about():
    """The nominal motions that agents remember are L apart, and their errors within the bounds."""
    env = worlds(CROWD, bangs(4), 12)
    wearing = ProvedFilter(Rush(env, noise=20.0), TASK, CROWD, disturbance_bound=BOUND)
    reserve = wearing.reserved.reserve
    beta = reserve.stopping_time
    length = reserve.distance(CROWD.agent_radius, CROWD.agent_radius)
    observation, _ = env.reset(seed=list(range(12)))
    goals = env.states[..., :2].reshape(-1, 2) + observation[:, :2]
    first, second = np.triu_indices(CROWD.agents, 1)
    state, worst = None, 0.0
    for _ in range(100):
        action, state = wearing.predict(observation, state)
        observation, *_ = env.step(action)
        place, speed = goals + state.memory[:, :2], state.memory[:, 2:]
        segments = np.stack([place, place + beta * speed], axis=1)
        segments = segments.reshape(12, CROWD.agents, 2, 2)
        for one in segments:
            assert segment_distance(one[first], one[second]).min() > length - 1e-5
        actual = env.states.reshape(-1, 6)
        error, pace = actual[:, :2] - place, actual[:, 3:5] - speed
        worst = max(worst, np.linalg.norm(error, axis=1).max() / reserve.place_error)
        assert np.linalg.norm(error, axis=1).max() <= reserve.place_error
        assert np.linalg.norm(error + beta * pace, axis=1).max() <= reserve.stop_error
        assert np.linalg.norm(speed, axis=1).max() <= wearing.reserved.speed + 1e-6
    assert wearing.counters(state)["infeasible"] == 0
    # The bounds are no mere formality.
    assert worst > 0.6


@pytest.mark.parametrize(
    "fault",
    [
        {"gain": double_pole(0.9, 0.1)},
        {"clearance": 0.02},
        {"clearance": 0.04, "place_error": 0.0, "stop_error": 0.0},
    ],
    ids=["weak", "no room", "shrunk"],
)
def test_faults_are_found(fault):
    """Were the constants others than those proved, the same pushes would make agents meet."""
    hit = 0
    for every in (0, 3):
        _, touched, _ = flown(CROWD, proved(CROWD, **fault), bangs(every), 12, 80)
        hit += touched.sum()
    assert hit > 0


def test_a_brake_that_is_weaker_than_the_proof_says_is_found():
    weak = dataclasses.replace(TASK, thrust_limit=0.6)
    _, touched, _ = flown(CROWD, proved(CROWD), bangs(), 12, 80, weak)
    assert touched.any()


def test_who_looks_the_wrong_way_is_found(monkeypatch):
    def turned(*args):
        found = zones_beside_bodies(*args)
        return found._replace(x=-found.y, y=found.x)

    monkeypatch.setattr(proved_filter, "zones_beside_bodies", turned)
    _, touched, _ = flown(CROWD, proved(CROWD), bangs(), 12, 80)
    assert touched.any()


# The constants.


@pytest.mark.parametrize("bound", [0.1, 0.4, 0.7])
def test_the_worst_pushes_come_near_the_proved_errors_and_never_beyond(bound):
    """In the environment itself: agents hold a place, pushed by what is worst for it."""
    found = reserved_for(TASK, PAPER, bound)
    gain, h, beta = found.gain, TASK.control_period, found.reserve.stopping_time
    steps, worst = 25, []
    for row in ([1.0, 0.0], [1.0, beta]):
        powers = [np.array(row) @ np.linalg.matrix_power(gain.step, lag) for lag in range(steps)]
        sequence = np.zeros((steps, 6))
        for lag, one in enumerate(powers):
            along = np.array([h * one[0], 0.5 * h * h * one[0] + h * one[1]])
            along /= np.hypot(*along)
            sequence[steps - 1 - lag, [0, 3]] = bound * along

        def push(situation, sequence=sequence):
            step = min(round(float(np.max(situation.time)) / h), steps - 1)
            return np.broadcast_to(sequence[step], situation.state.shape)

        alone = Preset(agents=1, obstacle_count=(0, 0), heading_range=np.pi)
        env = SpacecraftVectorEnv(20, 1, alone, push, bound, autoreset_mode="disabled")
        env.reset(seed=list(range(20)))
        start = env.states.copy()
        for _ in range(steps):
            error = (env.states - start).reshape(-1, 6)
            answer = gain.deviation(error[:, :2], error[:, 3:5])
            pull = np.concatenate([answer, np.zeros((20, 1))], axis=1)
            thrust = held_thrust(TASK.system, env.states.reshape(-1, 6), pull, h)
            env.step(thrust.astype(np.float32))
        error = (env.states - start).reshape(-1, 6)
        combined = error[:, :2] * row[0] + error[:, 3:5] * row[1]
        worst.append(np.linalg.norm(combined, axis=1).max())
    shares = np.array(worst) / [found.reserve.place_error, found.reserve.stop_error]
    assert np.all(shares <= 1.0)
    assert np.all(shares > 0.75)


def test_starts_are_covered_up_to_a_bound_and_no_farther():
    most = largest_bound(TASK, PAPER)
    assert 0.5 < most < 1.0
    for bound, covered in ((most, True), (most + 0.01, False)):
        found = reserved_for(TASK, PAPER, bound)
        assert (found.holds and found.covers_starts) is covered
    found = reserved_for(TASK, PAPER, BOUND)
    assert found.reserve.clearance <= PAPER.margin
    # A thrust limit leaves less for the answer to d.
    limited = [
        largest_bound(dataclasses.replace(TASK, thrust_limit=one), PAPER, ReserveSettings())
        for one in (1, 4)
    ]
    assert 0.0 < limited[0] < limited[1] < most


def test_the_bounds_are_for_any_number_of_steps(monkeypatch):
    """Each step's worst push, summed over as many steps as the longest episodes have."""
    task = dataclasses.replace(TASK, time_limit=588.0)
    found = reserved_for(task, PAPER, BOUND)
    gain, h, beta = found.gain, task.control_period, found.reserve.stopping_time
    size, powers = np.zeros(2), np.eye(2)
    for _ in range(task.steps):
        for index, row in enumerate(([1.0, 0.0], [1.0, beta])):
            place, speed = np.array(row) @ powers
            size[index] += BOUND * np.hypot(h * place, 0.5 * h * h * place + h * speed)
        powers = powers @ gain.step
    bounds = np.array([found.reserve.place_error, found.reserve.stop_error])
    assert np.all(size < bounds)
    assert np.all(size > 0.75 * bounds)
    # Where the sums end changes nothing but how much is lost there: little, and never a gain.
    monkeypatch.setattr(reserved, "_LAGS", 12)
    reserved_for.cache_clear()
    shorter = reserved_for(task, PAPER, BOUND, ReserveSettings(pole=0.1)).reserve
    monkeypatch.undo()
    reserved_for.cache_clear()
    longer = reserved_for(task, PAPER, BOUND, ReserveSettings(pole=0.1)).reserve
    assert longer.place_error <= shorter.place_error < 1.01 * longer.place_error


@pytest.mark.parametrize(("name", "agents"), [("paper", 6), ("swarm", 1024), ("gcbf", 1024)])
def test_nobody_comes_farther_than_is_proved(name, agents):
    """From the start, at the largest speed of nominal motions alone."""
    preset = PRESETS[name].for_agents(agents)
    task = settings_for(preset)
    found = reserved_for(task, preset, 0.2)
    assert found.holds
    assert found.farthest > preset.longest_way + task.time_limit * found.speed


@pytest.mark.parametrize(
    ("settings", "bound", "reserve"),
    [
        (dataclasses.replace(TASK, thrust_limit=0.5), 0.4, None),
        (dataclasses.replace(TASK, sensing_radius=1.0), 0.4, None),
        (dataclasses.replace(TASK, speed_limit=1.0), 0.4, None),
        (TASK, 0.4, ReserveSettings(stopping_time=0.4)),
        (TASK, 20.0, None),
    ],
    ids=["thrust", "sensing", "speed", "stop", "bound"],
)
def test_what_is_not_proved_is_refused(settings, bound, reserve):
    env = worlds(PAIR, "none", 1)
    with pytest.raises(ValueError, match="use a smaller"):
        ProvedFilter(Rush(env), settings, PAIR, disturbance_bound=bound, reserve=reserve)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_proved_at_the_bound_of_its_results(name):
    preset = PRESETS[name].for_agents(1024)
    found = reserved_for(settings_for(preset), preset, BOUND)
    assert found.holds
    assert found.covers_starts


def test_what_thrust_is_left_makes_a_body_as_fast_as_the_proof_lets_it():
    preset = PRESETS["gcbf"]
    task = settings_for(preset)
    chosen = [reserved_for(task, preset, bound) for bound in (0.1, 0.2, 0.3, 0.4)]
    speeds = [one.speed for one in chosen]
    assert speeds == sorted(speeds, reverse=True)
    # No slower than what the usual stop allows, where that holds.
    usual = reserved_for(task, preset, 0.2, ReserveSettings())
    assert usual.holds
    assert chosen[1].speed >= usual.speed


def test_settings_are_checked():
    for given in ({"pole": 1.0}, {"spin": 0.0}, {"acceleration": -1.0}):
        with pytest.raises(ValueError, match=next(iter(given))):
            ReserveSettings(**given)


# The wrapper.


def test_where_nothing_is_near_the_action_is_the_policys_own():
    far = Preset(agents=3, arena=60.0, obstacle_count=(0, 0), least_way=0.0)
    env = worlds(far, "uniform", 4)
    inner = Rush(env, noise=1.0)
    wearing = ProvedFilter(Still(inner), TASK, far, disturbance_bound=BOUND)
    observation, _ = env.reset(seed=[0, 1, 2, 3])
    state = None
    for _ in range(5):
        action, state = wearing.predict(observation, state)
        np.testing.assert_array_equal(action, np.full(action.shape, 0.25, np.float32))
        observation, *_ = env.step(action)
    assert wearing.counters(state)["interventions"] == 0


class Still(BasePolicy):
    """All thrusters against each other."""

    name = "still"

    def __init__(self, inner):
        self.inner = inner

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 8), 0.25, np.float32), None


def test_neither_the_order_of_the_slots_nor_a_batch_means_anything():
    env = worlds(CROWD, bangs(), 12)
    wearing = proved(CROWD)(Given())
    observation, _ = env.reset(seed=list(range(12)))
    push = Rush(env)
    state, rng = None, np.random.default_rng(0)
    at, slots = wearing.layout.slices, wearing.layout.neighbours
    for _ in range(40):
        wearing.policy.inner.answer, _ = push.predict(observation)
        action, after = wearing.predict(observation, state)
        order = rng.permutation(slots)
        mixed = observation.copy()
        some = mixed[:, at["neighbours"]].reshape(len(mixed), slots, 4)[:, order]
        mixed[:, at["neighbours"]] = some.reshape(len(mixed), -1)
        mixed[:, at["neighbour_mask"]] = mixed[:, at["neighbour_mask"]][:, order]
        again, _ = wearing.predict(mixed, state)
        np.testing.assert_allclose(again, action, atol=1e-5)
        state = after
        observation, *_ = env.step(action)
    assert wearing.counters(state)["interventions"] > 100


class Given:
    """Answers what it is given."""

    name, observes, answer = "given", "local", None

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.answer, None


def test_an_episode_that_starts_forgets_the_nominal_motions():
    env = worlds(CROWD, bangs(), 12)
    wearing = proved(CROWD)(Rush(env))
    observation, _ = env.reset(seed=list(range(12)))
    rows = len(observation)
    _, state = wearing.predict(observation, None)
    moved = state._replace(memory=state.memory + 5.0)
    starts = np.ones(rows, bool)
    starts[: rows // 2] = False
    _, after = wearing.predict(observation, moved, starts)
    # At the time zero everybody begins, said or not; then those who are said to.
    assert np.abs(after.memory - state.memory).max() < 1.0
    later = observation.copy()
    later[:, wearing.layout.slices["time"]] = 3.0
    _, after = wearing.predict(later, moved, starts)
    # Who goes on cannot be five metres from its nominal motion.
    assert wearing.counters(after)["infeasible"] == np.sum(~starts)


class Seek(Rush):
    """Each flies to its own goal, at a moderate pace."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        sensed = Sensed.of(self.layout, observation)
        distance = np.linalg.norm(sensed.goal, axis=1, keepdims=True)
        push = 3.0 * (0.5 * sensed.goal / np.maximum(distance, 0.5) - sensed.velocity)
        force = to_body(push, sensed.heading)
        thrust = allocate(TASK.system, np.concatenate([force, 0.0 * force[:, :1]], axis=1))
        return thrust.astype(np.float32), None


def test_who_meet_head_on_pass_each_other():
    """Goals opposite to starts on a circle: the filter leaves the way around, and leads there."""
    ring = dataclasses.replace(PRESETS["crossing"], agents=2)
    env = worlds(ring, "none", 6)
    wearing = proved(ring)(Seek(env))
    observation, info = env.reset(seed=list(range(6)))
    state = None
    for _ in range(250):
        action, state = wearing.predict(observation, state)
        observation, *_, info = env.step(action)
    assert info["success"].all()
    assert not info["collided"].any()
    assert wearing.counters(state)["interventions"] > 0
