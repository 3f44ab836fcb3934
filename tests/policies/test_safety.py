"""The safety filter: exact, least, permutation-blind, and nothing is touched."""

import dataclasses

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.conventions import beyond_the_end
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy, Policy
from lagros_policies.safety.barrier import BarrierSettings, BrakingBarrier
from lagros_policies.tasks.spacecraft.filtering import FilterState
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate
from tests.policies.programs import least_violation_by_program, nearest_by_program

PERIOD = 0.1
BODY = Spacecraft()


class Thrust(BasePolicy):
    """Answers with the same thrust always, and notes what it is asked."""

    name = "thrust"

    def __init__(self, thrust, observes="local"):
        self.thrust, self.observes, self.asked, self.generator = thrust, observes, [], None

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.asked.append((state, episode_start, deterministic))
        return self.thrust, 1 if state is None else state + 1

    def counters(self, state):
        return {"calls": state}

    def reseed(self, generator):
        self.generator = generator


class Reckless:
    """Flies straight to its goal at a given speed, whatever is in between."""

    name = "reckless"

    def __init__(self, layout, speed, observes="local"):
        self.layout, self.speed, self.observes = layout, speed, observes

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        sensed = Sensed.of(self.layout, observation)
        distance = np.linalg.norm(sensed.goal, axis=1, keepdims=True)
        wanted = sensed.goal * np.minimum(0.8, self.speed / np.maximum(distance, 1e-9))
        push = 3.0 * (wanted - sensed.velocity)
        return thrust_for(push, sensed.heading, np.zeros(len(push))), state


def thrust_for(acceleration, heading, torque):
    """Return thrust for accelerations in the world, by the body's axes written out."""
    first = np.cos(heading) * acceleration[:, 0] - np.sin(heading) * acceleration[:, 1]
    second = np.sin(heading) * acceleration[:, 0] + np.cos(heading) * acceleration[:, 1]
    return allocate(BODY, np.stack([first, second, torque], axis=-1)).astype(np.float32)


def acceleration_of(action, sensed):
    """Return what an action does over the hold, by the equation of motion at its middle."""
    torque = np.array(BODY.wrench(list(action.T)))[2]
    middle = sensed.heading + 0.05 * sensed.spin + 0.125 * 0.01 * torque / 2.0
    zero = np.zeros_like(middle)
    rates = BODY.derivative([zero, zero, middle, zero, zero, zero], list(action.T), np)
    return np.stack([rates[3], rates[4]], axis=-1), rates[5]


def situations(layout, count, seed, near=0.9):
    """Return observations of agents among random neighbours and obstacles, some in contact."""
    rng = np.random.default_rng(seed)
    rows, at = np.zeros((count, layout.size)), layout.slices
    angle = rng.uniform(-np.pi, np.pi, count)
    rows[:, at["goal"]] = rng.normal(size=(count, 2))
    rows[:, at["velocity"]] = 0.4 * rng.normal(size=(count, 2))
    rows[:, at["heading"]] = np.stack([np.cos(angle), np.sin(angle), angle], axis=-1)
    rows[:, at["spin"]] = rng.normal(size=(count, 1))
    for part, slots, least in (("neighbour", layout.neighbours, 0.5), ("obstacle", None, 0.75)):
        slots = layout.obstacles if slots is None else slots
        mask = rng.random((count, slots)) < 0.4
        way = rng.uniform(-np.pi, np.pi, (count, slots))
        distance = least + near * rng.random((count, slots))
        values = [distance * np.cos(way), distance * np.sin(way)]
        if part == "neighbour":
            values += list(0.4 * rng.normal(size=(2, count, slots)))
        else:
            values.append(np.full((count, slots), 0.5))
        stacked = np.stack(values, axis=-1) * mask[..., None]
        rows[:, at[f"{part}s"]] = stacked.reshape(count, -1)
        rows[:, at[f"{part}_mask"]] = mask
    return rows.astype(np.float32)


def filter_of(action, preset="paper", agents=6, settings=None, **arguments):
    return SafetyFilter(Thrust(action), settings, preset, agents, **arguments)


def test_it_is_a_policy():
    wearing = filter_of(np.zeros((1, 8), np.float32))
    assert isinstance(wearing, Policy)
    assert (wearing.name, wearing.observes) == ("thrust+filter", "local")


def test_an_action_that_needs_no_change_is_untouched_bit_for_bit():
    rng = np.random.default_rng(6)
    action = rng.uniform(-0.2, 1.3, (200, 8)).astype(np.float32)
    wearing = filter_of(action)
    rows = situations(wearing.layout, 200, seed=7, near=1.5)
    sensed = Sensed.of(wearing.layout, rows)
    filtered, state = wearing.predict(rows)
    _, changed, _ = wearing.filter(action, sensed)
    assert 10 < changed.sum() < 190
    assert np.array_equal(filtered[~changed], action[~changed])
    assert np.array_equal(state.counts[:, 1] == 1, changed)


def test_the_force_is_changed_least_and_the_torque_is_kept():
    rng = np.random.default_rng(8)
    settings = BarrierSettings(sidestep_speed=0.0, largest_acceleration=1e3)
    action = thrust_for(
        rng.normal(size=(150, 2)), rng.uniform(-3.0, 3.0, 150), rng.normal(size=150)
    )
    wearing = filter_of(action, barrier=settings)
    rows = situations(wearing.layout, 150, seed=9)
    sensed = Sensed.of(wearing.layout, rows)
    filtered, changed, infeasible = wearing.filter(action, sensed)
    (before, turn), (after, turned) = (acceleration_of(a, sensed) for a in (action, filtered))
    assert turned == pytest.approx(turn, abs=1e-5)
    planes = wearing.barrier.half_planes(sensed.velocity, *sensed[1:])
    checked = np.flatnonzero(changed & ~infeasible)
    assert checked.size > 30
    for row in checked[:60]:
        present = (planes.x[row] != 0.0) | (planes.y[row] != 0.0)
        normals = np.stack([planes.x[row], planes.y[row]], axis=-1)[present]
        expected = nearest_by_program(before[row], normals, planes.bounds[row][present])
        assert after[row] == pytest.approx(expected, abs=1e-4)


def braking_by_hand(gap, rate, k, braking):
    """Return phi(g) and its slope by the cases of the definition."""
    if gap < braking / k**2:
        return k * gap, k
    speed = np.sqrt(2.0 * braking * gap - (braking / k) ** 2)
    return speed, braking / speed


def test_each_half_plane_is_the_condition_on_the_end_of_the_hold():
    # One neighbour and one obstacle, from the definition: at the bound of its half-plane the rate
    # at the end of the hold is what may still be braked, the neighbour doing its own half.
    kept = BarrierSettings()
    barrier = BrakingBarrier(kept, 0.25, 0.25, PERIOD)
    layout = Layout.for_preset(PRESETS["paper"].for_agents(6), SpacecraftSettings())
    sensed = Sensed.of(layout, situations(layout, 300, seed=10, near=1.4))
    planes = barrier.half_planes(sensed.velocity, *sensed[1:])
    seen = 0
    for row in range(300):
        for slot in np.flatnonzero((planes.x[row] != 0.0) | (planes.y[row] != 0.0)):
            normal = np.array([planes.x[row, slot], planes.y[row, slot]])
            pair = slot < layout.neighbours
            if pair:
                centre, drift = np.split(sensed.neighbours[row, slot], 2)
                reach, k, braking = 0.5 + kept.pair_margin, kept.pair_rate, 2.0 * kept.braking
            else:
                centre = sensed.obstacles[row, slot - layout.neighbours, :2]
                reach, k, braking = 0.75 + kept.obstacle_margin, kept.obstacle_rate, kept.braking
                drift = -sensed.velocity[row]
            assert normal == pytest.approx(-centre / np.linalg.norm(centre))
            gap, rate = np.linalg.norm(centre) - reach, -normal @ drift
            together = planes.bounds[row, slot] * (2.0 if pair else 1.0)
            end_gap = gap + PERIOD * rate + 0.5 * PERIOD**2 * together
            phi, slope = braking_by_hand(gap + PERIOD * rate, rate, k, braking)
            tangent = phi + slope * 0.5 * PERIOD**2 * together
            assert rate + PERIOD * together == pytest.approx(-tangent, abs=1e-9)
            assert end_gap == pytest.approx(gap + PERIOD * rate + (tangent - phi) / slope)
            seen += 1
    assert seen > 500


def test_a_gap_along_one_line_stays_open_through_every_hold():
    # The property that the module proves: one dimension, any state that may still brake.
    rng = np.random.default_rng(11)
    kept = BarrierSettings(obstacle_rate=10.0, obstacle_margin=0.0)
    barrier = BrakingBarrier(kept, 0.25, 0.25, PERIOD)
    gap = rng.uniform(0.0, 1.0, 500)
    speed, _ = barrier.allowed_speed(gap, np.array(10.0), np.array(1.0))
    rate = -speed * rng.uniform(-0.5, 1.0, 500)
    inside = np.linspace(0.0, PERIOD, 11)[:, None]
    for _ in range(60):
        coasting = gap + PERIOD * rate
        phi, slope = barrier.allowed_speed(coasting, np.array(10.0), np.array(1.0))
        push = -(rate + phi) / (PERIOD + 0.5 * PERIOD**2 * slope)
        # As hard towards the obstacle as the half-plane lets it.
        push = np.maximum(push, -3.0)
        assert np.min(gap + inside * rate + 0.5 * inside**2 * push) > -1e-3
        gap, rate = coasting + 0.5 * PERIOD**2 * push, rate + PERIOD * push


@pytest.mark.parametrize("preset", ["paper", "crossing"])
def test_without_disturbance_reckless_agents_touch_nothing(preset):
    env = SpacecraftVectorEnv(48, 6, preset, autoreset_mode="disabled")
    observation, _ = env.reset(seed=12)
    policies = (
        SafetyFilter(Reckless(env.layout, 0.4), preset=preset, disturbance_bound=0.0),
        Reckless(env.layout, 0.4),
    )
    collided = []
    for policy in policies:
        observation, _ = env.reset(seed=12)
        state = None
        for _ in range(150):
            action, state = policy.predict(observation, state)
            with beyond_the_end():
                observation, _, _, _, info = env.step(action)
        collided.append(info["collided"].sum())
    assert collided[0] == 0
    assert collided[1] > 20


def test_two_that_meet_head_on_pass_each_other():
    scenario = Scenario([[1.0, 1.0], [4.0, 1.0]], [0.0, 0.0], [[4.0, 1.0], [1.0, 1.0]], [], [])
    passed = []
    for sidestep in (0.4, 0.0):
        env = SpacecraftVectorEnv(2, 2, "open", autoreset_mode="disabled")
        observation, _ = env.reset(seed=0, options={"scenarios": [scenario]})
        wearing = SafetyFilter(
            Reckless(env.layout, 0.3),
            preset="open",
            num_agents=2,
            barrier=BarrierSettings(sidestep_speed=sidestep),
        )
        state = None
        for _ in range(env.settings.steps):
            action, state = wearing.predict(observation, state)
            observation, _, _, _, info = env.step(action)
        assert not info["collided"].any()
        passed.append(info["success"].all())
    assert passed == [True, False]


def test_the_order_of_the_slots_means_nothing():
    rng = np.random.default_rng(13)
    action = rng.uniform(0.0, 0.5, (80, 8)).astype(np.float32)
    wearing = filter_of(action)
    at, layout = wearing.layout.slices, wearing.layout
    rows = situations(layout, 80, seed=14)
    mixed = rows.copy()
    for part, slots in (("neighbour", layout.neighbours), ("obstacle", layout.obstacles)):
        order = rng.permutation(slots)
        values = rows[:, at[f"{part}s"]].reshape(80, slots, -1)[:, order]
        mixed[:, at[f"{part}s"]] = values.reshape(80, -1)
        mixed[:, at[f"{part}_mask"]] = rows[:, at[f"{part}_mask"]][:, order]
    first, second = wearing.predict(rows), wearing.predict(mixed)
    assert np.any(first[0] != action)
    assert first[0] == pytest.approx(second[0], abs=1e-5)
    assert np.array_equal(first[1].counts, second[1].counts)


def test_a_batch_is_its_rows():
    rng = np.random.default_rng(15)
    action = rng.uniform(0.0, 0.5, (40, 8)).astype(np.float32)
    wearing = filter_of(action)
    rows = situations(wearing.layout, 40, seed=16)
    together, state = wearing.predict(rows)
    for row in range(40):
        wearing.policy.thrust = action[row]
        alone, own = wearing.predict(rows[row])
        assert alone.shape == (8,)
        assert alone == pytest.approx(together[row], abs=1e-6)
        assert np.array_equal(own.counts[0], state.counts[row])


@pytest.mark.parametrize("limit", [None, 0.5])
def test_thrusters_push_and_keep_their_limit(limit):
    rng = np.random.default_rng(17)
    settings = SpacecraftSettings(thrust_limit=limit, thrust_scale=2.0)
    # Twice the limit, and thrusters that pull: the filter sees what the environment would apply.
    action = rng.uniform(-0.3, 0.5, (300, 8)).astype(np.float32)
    wearing = filter_of(action, settings=settings)
    rows = situations(wearing.layout, 300, seed=18, near=0.4)
    filtered, changed, infeasible = wearing.filter(action, Sensed.of(wearing.layout, rows))
    assert changed.sum() > 200
    assert filtered.dtype == np.float32
    assert np.all(filtered[changed] >= 0.0)
    if limit is None:
        # No more than 4 m/s^2 along an axis of the body, and the torque.
        forces = np.array(BODY.wrench(list(2.0 * filtered[changed].T)))[:2]
        assert np.abs(forces).max() <= 4.0 + 1e-5
    else:
        assert filtered[changed].max() <= limit / 2.0 + 1e-6
        assert infeasible.sum() > 10


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("bound", [0.0, 0.4, 1.0, 3.0])
def test_limited_thrust_keeps_more_room_to_obstacles_and_leaves_it_to_starts(preset, bound):
    usual = BarrierSettings.for_bound(bound)
    kept = filter_of(np.zeros((1, 8)), preset, None, disturbance_bound=bound).barrier.settings
    limited = "thrust_limit" in dict(PRESETS[preset].task)
    assert kept.pair_margin == usual.pair_margin
    assert (kept.obstacle_margin > usual.obstacle_margin) == (limited and bound < 2.5)
    assert kept.obstacle_margin in (usual.obstacle_margin, kept.pair_margin, 0.375)
    given = filter_of(np.zeros((1, 8)), preset, None, barrier=usual).barrier.settings
    assert given.obstacle_margin == usual.obstacle_margin


def test_within_its_limit_the_filter_violates_least():
    rng = np.random.default_rng(19)
    settings = SpacecraftSettings(thrust_limit=0.4)
    action = thrust_for(rng.normal(size=(120, 2)), rng.uniform(-3.0, 3.0, 120), np.zeros(120))
    action = np.minimum(action, np.float32(0.4))
    kept = BarrierSettings(sidestep_speed=0.0)
    wearing = filter_of(action, settings=settings, barrier=kept)
    rows = situations(wearing.layout, 120, seed=20, near=0.4)
    rows[:, wearing.layout.slices["spin"]] = 0.0
    sensed = Sensed.of(wearing.layout, rows)
    filtered, changed, infeasible = wearing.filter(action, sensed)
    after, _ = acceleration_of(filtered, sensed)
    planes = wearing.barrier.half_planes(sensed.velocity, *sensed[1:])
    compared = 0
    for row in np.flatnonzero(changed & infeasible):
        torque = BODY.wrench(list(action[row]))[2]
        sine, cosine = np.sin(sensed.heading[row]), np.cos(sensed.heading[row])
        axes = np.array([[cosine, -sine], [sine, cosine]])
        if abs(torque) > 1e-6:
            continue
        normals = np.concatenate([np.stack([planes.x[row], planes.y[row]], axis=-1), axes, -axes])
        limits = np.concatenate([planes.bounds[row], np.full(4, -0.8)])
        softness = np.repeat([1.0, 0.3, 0.0], [5, 6, 4])
        least = least_violation_by_program(normals, limits, softness)
        assert np.all(normals @ after[row] >= limits - softness * least - 1e-4)
        compared += 1
    assert compared > 20


def test_interventions_and_what_is_impossible_are_counted():
    # Alone; towards an obstacle at speed; and between two obstacles that it overlaps.
    layout = filter_of(None).layout
    rows = np.zeros((3, layout.size), np.float32)
    at = layout.slices
    rows[:, at["heading"].start] = 1.0
    rows[1, at["velocity"]] = [0.4, 0.0]
    obstacles = rows[:, at["obstacles"]].reshape(3, -1, 3)
    obstacles[1, 0] = [0.9, 0.0, 0.5]
    obstacles[2, :2] = [[0.7, 0.0, 0.5], [-0.7, 0.0, 0.5]]
    rows[:, at["obstacles"]] = obstacles.reshape(3, -1)
    rows[1, at["obstacle_mask"].start] = 1.0
    rows[2, at["obstacle_mask"].start : at["obstacle_mask"].start + 2] = 1.0
    wearing = filter_of(np.zeros((3, 8), np.float32))
    _, state = wearing.predict(rows)
    assert state.counts.tolist() == [[1, 0, 0], [1, 1, 0], [1, 1, 1]]
    _, state = wearing.predict(rows, state, np.array([False, True, False]), deterministic=False)
    assert state.counts.tolist() == [[2, 0, 0], [1, 1, 0], [2, 2, 2]]
    inner_state, starts, deterministic = wearing.policy.asked[1]
    assert inner_state == 1
    assert starts.tolist() == [False, True, False]
    assert not deterministic
    assert wearing.counters(state) == {
        "calls": 2,
        "filtered_steps": 5,
        "interventions": 3,
        "infeasible": 2,
    }
    generator = np.random.default_rng(0)
    wearing.reseed(generator)
    assert wearing.policy.generator is generator


def test_a_policy_that_counts_and_draws_nothing_can_wear_it():
    env = spacecraft_v0.parallel_env(3, "paper")
    wearing = SafetyFilter(Reckless(env.episode.layout, 0.3), env.settings, env.preset)
    env.reset(seed=0)
    wearing.reseed(np.random.default_rng(0))
    state = FilterState(None, np.array([[4, 2, 1], [1, 1, 0], [0, 0, 0]]))
    assert wearing.counters(state) == {"filtered_steps": 5, "interventions": 3, "infeasible": 1}


@pytest.mark.parametrize(("preset", "agents"), [("paper", 6), ("open", 1), ("released", 3)])
def test_global_and_local_policies_are_filtered_alike(preset, agents):
    env = SpacecraftVectorEnv(20 * agents, agents, preset, autoreset_mode="disabled")
    observation, _ = env.reset(seed=21)
    reckless = Reckless(env.layout, 0.6)
    local = SafetyFilter(reckless, preset=preset, num_agents=agents)
    world = SafetyFilter(Thrust(None, "global"), preset=preset, num_agents=agents)
    assert world.observes == "global"
    interventions = 0
    for _ in range(60):
        thrust, _ = reckless.predict(observation)
        world.policy.thrust = thrust.reshape(20, agents, 8)
        seen_locally, own = local.predict(observation)
        seen_globally, all_ = world.predict(env.state())
        assert seen_globally.shape == (20, agents, 8)
        assert seen_globally.reshape(-1, 8) == pytest.approx(seen_locally, abs=1e-3)
        assert np.array_equal(all_.counts, own.counts.reshape(20, agents, 3).sum(axis=1))
        interventions += own.counts[:, 1].sum()
        observation, *_ = env.step(thrust)
    assert interventions > 20 or preset == "open"
    world.policy.thrust = thrust.reshape(20, agents, 8)[0]
    assert world.predict(env.state()[0])[0].shape == (agents, 8)


def test_what_lies_beyond_the_sensing_radius_changes_nothing():
    far = Scenario([[0.0, 0.0], [1.5, 0.0]], [0.0, 0.0], [[4.0, 0.0], [0.0, 4.0]], [], [])
    settings = SpacecraftSettings(sensing_radius=1.0)
    env = spacecraft_v0.parallel_env(2, "open", settings=settings)
    env.reset(seed=0, options={"scenario": far})
    # So fast that an agent who sees the other brakes.
    state = env.state().copy()
    state[1 + 3] = 2.0
    push = np.zeros((2, 8), np.float32)
    for radius, changed in ((1.0, 0), (2.0, 2)):
        wearing = SafetyFilter(
            Thrust(push, "global"),
            dataclasses.replace(settings, sensing_radius=radius),
            "open",
            2,
        )
        _, memory = wearing.predict(state)
        assert memory.counts.tolist() == [[2, changed, 0]]


def test_errors_name_what_is_wrong():
    with pytest.raises(TypeError, match=r"a object has no method predict\(observation"):
        SafetyFilter(object())
    with pytest.raises(ValueError, match=r'observes=.* must be "local" or "global"'):
        SafetyFilter(Thrust(None, "nothing"))
    with pytest.raises(ValueError, match=r"disturbance_bound=-1\.0"):
        filter_of(None, disturbance_bound=-1.0)
    with pytest.raises(ValueError, match=r"pair_margin=nan"):
        BarrierSettings(pair_margin=float("nan"))
    with pytest.raises(ValueError, match=r"braking=0\.0 must be finite and > 0"):
        BarrierSettings(braking=0.0)
    with pytest.raises(ValueError, match=r"pair_rate=11\.0 1/s must be at most"):
        filter_of(None, barrier=BarrierSettings(pair_rate=11.0))
    wearing = filter_of(np.zeros((2, 8), np.float32))
    rows = situations(wearing.layout, 2, seed=0)
    with pytest.raises(ValueError, match="num_agents"):
        wearing.predict(rows[:, :-1])
    with pytest.raises(ValueError, match="for these 2 rows"):
        wearing.predict(rows, FilterState(None, np.zeros((3, 3), np.int64)))
    state = wearing.predict(rows)[1]
    with pytest.raises(ValueError, match="episode_start has 3 entries"):
        wearing.predict(rows, state, np.zeros(3, bool))
    wearing.policy.thrust = np.zeros((2, 7), np.float32)
    with pytest.raises(ValueError, match=r"thrust answered with shape \(2, 7\) for 2 agents"):
        wearing.predict(rows)
    wearing.policy.thrust = np.full((2, 8), np.nan, np.float32)
    with pytest.raises(ValueError, match="action of thrust is not finite"):
        wearing.predict(rows)
    everything = SafetyFilter(Thrust(None, "global"))
    with pytest.raises(ValueError, match=r"the state\(\) of 6 agents"):
        everything.predict(np.zeros(5, np.float32))


@pytest.mark.parametrize(("sideways", "passes"), [(0.2, 0.2), (-0.2, -0.2), (0.0, 1.0)])
def test_who_already_passes_goes_on_the_same_way_and_clockwise_else(sideways, passes):
    # An obstacle to the east, the goal behind it: clockwise about it leads north (y > 0).
    layout = filter_of(None).layout
    row, at = np.zeros((1, layout.size), np.float32), layout.slices
    row[0, at["heading"].start] = 1.0
    row[0, at["goal"]] = [3.0, 0.0]
    row[0, at["velocity"]] = [0.1, sideways]
    row[0, at["obstacles"].start : at["obstacles"].start + 3] = [0.8, 0.0, 0.5]
    row[0, at["obstacle_mask"].start] = 1.0
    wearing = filter_of(thrust_for(np.array([[2.0, 0.0]]), np.zeros(1), np.zeros(1)))
    sensed = Sensed.of(layout, row)
    filtered, changed, _ = wearing.filter(wearing.policy.thrust, sensed)
    after, _ = acceleration_of(filtered, sensed)
    assert changed[0]
    assert np.sign(after[0, 1]) == np.sign(passes)
