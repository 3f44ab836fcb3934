"""C3M: its conditions by hand and by differences, its training, its file, its policy."""

import json
import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from lagros_envs.dynamics import hold_step, linearise_hold, vector_field
from lagros_envs.env import TaskEnv
from lagros_envs.registry import task_named
from lagros_envs.task import Scenario, Task
from lagros_envs.tasks import SHIPPED
from lagros_policies import make
from lagros_policies.c3m import C3mPolicy, ContractionNetworks
from lagros_policies.contraction import BoxRegion
from lagros_policies.learning.c3m import C3mFit, C3mSettings, fit_c3m, region_of
from lagros_policies.learning.c3m_conditions import (
    Hold,
    Networks,
    lacking,
    motion_at,
    scaled_of,
    single,
)
from lagros_policies.room import shipped_file
from lagros_policies.trained_for import training_of, weights_record

TINY = C3mSettings(
    samples=128, epochs=2, batch=32, width=16, directions=32, checks=64, checkpoint_every=1
)
SINGLE = [name for name in SHIPPED if task_named(name).most_agents == 1]
LEARNED = [name for name in SINGLE if shipped_file(task_named(name), "c3m.safetensors").is_file()]


@dataclass(frozen=True)
class Line:
    """[position, speed] under an acceleration."""

    state_dim: int = 2
    control_dim: int = 1

    def derivative(self, state, control, functions):
        return state[1], control[0]


@dataclass(frozen=True)
class Glide(Task):
    system: Line = field(default_factory=Line)
    name, title = "glide", "Glide"

    def sample(self, rng):
        return Scenario(np.zeros(2), np.array([rng.uniform(-1.0, 1.0), 0.0]))


BOX = BoxRegion((-1.0, -1.0), (1.0, 1.0), (0.5, 0.5), (-1.0,), (1.0,))


def constant(networks, part, values):
    """Make a part of the networks answer the same everywhere."""
    with torch.no_grad():
        for value in networks.parts[part].parameters():
            value.zero_()
        networks.parts[part][2].bias.copy_(torch.tensor(values, dtype=torch.float32))


def linear(gain, factor):
    """Return networks of `Glide` whose control is about -gain e and whose metric is constant."""
    scaled = scaled_of(Glide(), BOX, np.random.default_rng(0))
    assert scaled.seen == ()
    assert (scaled.free, scaled.moved) == ((0,), (1,))
    networks = Networks(scaled, 8, 0.1, 0)
    small = 1e-3
    rows = np.zeros((6, 2))
    rows[0] = small * np.array(gain)
    constant(networks, "inner", rows.ravel())
    constant(networks, "outer", [-1.0 / small, 0, 0, 0, 0, 0])
    constant(networks, "base", [factor[0][0]])
    constant(networks, "rest", [factor[0][1], factor[1][1]])
    return networks


GAIN, RATE = (2.0, 3.0), 0.5


def gain_of(networks):
    """Return K of u = -K e, in units of the states, of networks whose scaled gain is `GAIN`."""
    return networks.scaled.control_scale * np.array([GAIN]) / networks.scaled.scale


FACTOR = np.array([[1.0, 0.5], [0.0, 2.0]])


def asked(networks, held=False):
    rng = np.random.default_rng(3)
    state, nominal = rng.uniform(-0.1, 0.1, (2, 5, 2))
    motion = motion_at(Glide(), networks.scaled, state)
    hold = Hold(Glide(), networks.scaled, state) if held else None
    here, there = single(state), single(nominal)
    return networks.conditions(here, there, single(np.zeros((5, 1))), motion, RATE, hold)


def test_conditions_of_a_double_integrator_are_those_by_hand():
    networks = linear(GAIN, FACTOR)
    found = asked(networks)
    a, b, k = np.array([[0, 1.0], [0, 0]]), np.array([[0], [1.0]]), gain_of(networks)
    w = FACTOR.T @ FACTOR + 0.1 * np.eye(2)
    m, loop = np.linalg.inv(w), a - b @ k
    closed = m @ loop + loop.T @ m + 2 * RATE * m
    for row in range(5):
        np.testing.assert_allclose(found.dual[row].detach(), w, rtol=1e-6)
        np.testing.assert_allclose(found.closed[row].detach(), closed, rtol=1e-4, atol=1e-4)
        # B_ is the first unit vector: 2 W_12 + 2 lambda W_11.
        wanted = 2 * w[0, 1] + 2 * RATE * w[0, 0]
        np.testing.assert_allclose(found.open[row].detach(), [[wanted]], rtol=1e-5)
        np.testing.assert_allclose(found.turned[row].detach(), 0.0, atol=1e-7)


def test_the_condition_of_a_hold_is_that_by_hand():
    networks = linear(GAIN, FACTOR)
    found = asked(networks, held=True)
    h = Glide().control_period
    f, g = np.array([[1, h], [0, 1.0]]), np.array([[h * h / 2], [h]])
    m = np.linalg.inv(FACTOR.T @ FACTOR + 0.1 * np.eye(2))
    loop = f - g @ gain_of(networks)
    wanted = (loop.T @ m @ loop - math.exp(-2 * RATE * h) * m) / h
    np.testing.assert_allclose(found.closed[0].detach(), wanted, rtol=1e-4, atol=1e-4)


def test_what_is_lacking_is_the_mean_of_what_is_positive():
    matrix = single(np.array([np.diag([2.0, -1.0]), np.diag([-1.0, -3.0])]))
    ways = single(np.eye(2))
    assert float(lacking(matrix, ways)) == 2.0
    assert float(lacking(-torch.eye(2)[None], ways)) == 0.0


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("held", [False, True])
def test_conditions_are_those_of_differences(name, held):
    task, period = task_named(name), task_named(name).control_period
    region = region_of(task) if task.metric is not None else box_of(task)
    rng = np.random.default_rng(5)
    scaled = scaled_of(task, region, rng)
    networks = Networks(scaled, 16, 0.1, 1)
    drawn = region.sample(rng, 4)
    unit, centre = scaled.scale, np.array(task.control_centre)
    state, nominal = drawn.state / unit, drawn.nominal / unit
    control = (drawn.nominal_control - centre) / scaled.control_scale
    found = networks.conditions(
        single(state),
        single(nominal),
        single(control),
        motion_at(task, scaled, drawn.state),
        RATE,
        Hold(task, scaled, drawn.state) if held else None,
    )
    law = networks.frozen_copy({})

    def answer(at):
        return law(at, drawn.nominal, drawn.nominal_control)

    def metric(at):
        inside = law.dual_metric(at) / unit[:, None] / unit
        return np.linalg.inv(inside)

    def after(at):
        # Half the substeps of the environment's own, as the condition takes them.
        moved, _, _ = linearise_hold(task.system, at, answer(at), period, 2)
        return moved

    step, n = 1e-3, len(unit)
    m = metric(drawn.state)
    if held:
        map_slope = np.stack(
            [
                (after(drawn.state + step * unit * e) - after(drawn.state - step * unit * e))
                / (2 * step * unit)
                for e in np.eye(n)
            ],
            axis=-1,
        )
        ahead = metric(after(drawn.state))
        wanted = map_slope.swapaxes(1, 2) @ ahead @ map_slope - math.exp(-2 * RATE * period) * m
        wanted /= period
        exact = hold_step(task.system, drawn.state, answer(drawn.state), period)
        np.testing.assert_allclose(after(drawn.state), exact, atol=1e-2)
    else:
        rate = vector_field(task.system, drawn.state, answer(drawn.state))
        slope = np.stack(
            [
                (
                    vector_field(task.system, one, answer(one))
                    - vector_field(task.system, other, answer(other))
                )
                / (2 * step * unit)
                for one, other in (
                    (drawn.state + step * unit * e, drawn.state - step * unit * e)
                    for e in np.eye(n)
                )
            ],
            axis=-1,
        )
        short = 1e-3 / max(1.0, np.abs(rate / unit).max())
        change = metric(drawn.state + short * rate) - metric(drawn.state - short * rate)
        wanted = change / (2 * short) + m @ slope + slope.swapaxes(1, 2) @ m + 2 * RATE * m
    size = np.abs(wanted).max()
    np.testing.assert_allclose(found.closed.detach(), wanted, rtol=2e-2, atol=2e-2 * size)


def box_of(task):
    """Return a small box around the goals of a task that describes none."""
    n = task.system.state_dim
    scale = np.array(task.state_scale or (1.0,) * n)
    goal = task.sample(np.random.default_rng(0)).goal
    centre = np.array(task.control_centre)
    return BoxRegion(
        tuple((goal - 0.2 * scale).tolist()),
        tuple((goal + 0.2 * scale).tolist()),
        tuple((0.1 * scale).tolist()),
        tuple((centre - 0.1).tolist()),
        tuple((centre + 0.1).tolist()),
    )


def test_gradient_of_the_loss_is_that_of_differences(tmp_path):
    # The control is not held: a gradient that leaves nothing out.
    run = C3mFit(Glide(), BOX, replace(TINY, held=False, largest=0.11), tmp_path / "progress")
    batch = np.arange(16)
    parameters = run.networks.parameters
    run.loss(batch).backward()
    rng = np.random.default_rng(0)
    ways = [rng.standard_normal(tuple(value.shape)) for value in parameters]
    told = sum(
        float((value.grad.double().numpy() * way).sum())
        for value, way in zip(parameters, ways, strict=True)
        if value.grad is not None
    )
    step, ends = 1e-3, []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            for value, way in zip(parameters, ways, strict=True):
                value.add_(single(sign * step * way))
        ends.append(float(run.loss(batch).detach()))
        with torch.no_grad():
            for value, way in zip(parameters, ways, strict=True):
                value.sub_(single(sign * step * way))
    assert told == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.05)


def test_training_brings_the_conditions_about_and_goes_on_after_a_stop(tmp_path):
    settings = replace(TINY, samples=512, epochs=30, batch=64, width=32, checks=256)
    networks, record = fit_c3m(Glide(), BOX, settings, tmp_path / "progress")
    assert record["kind"] == "observed"
    assert record["closed"] > 0.95
    assert record["open"] > 0.95
    state = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    law = networks.frozen_copy({})
    error = state - np.zeros(2)
    here = state
    for _ in range(60):
        here = hold_step(Glide().system, here, law(here, 0.0 * here, np.zeros((20, 1))), 0.1)
    assert np.linalg.norm(here, axis=1).max() < 0.3 * np.linalg.norm(error, axis=1).max()
    short = replace(TINY, epochs=4)
    whole, _ = fit_c3m(Glide(), BOX, short, tmp_path / "whole")
    run = C3mFit(Glide(), BOX, short, tmp_path / "cut")
    run.one_epoch()
    run.save()
    resumed, _ = fit_c3m(Glide(), BOX, short, tmp_path / "cut")
    for one, other in zip(whole.parameters, resumed.parameters, strict=True):
        assert torch.equal(one, other)


def test_networks_are_read_as_written_and_what_is_damaged_is_refused(tmp_path):
    task = task_named("pvtol")
    networks = Networks(scaled_of(task, region_of(task), np.random.default_rng(0)), 16, 0.1, 0)
    record = weights_record("pvtol", "c3m", training_of(task).range(timed=False))
    law = networks.frozen_copy(record)
    path = tmp_path / "pvtol_c3m.safetensors"
    law.save(path)
    read = ContractionNetworks.load(path)
    drawn = region_of(task).sample(np.random.default_rng(1), 6)
    at = drawn.state, drawn.nominal, drawn.nominal_control
    np.testing.assert_allclose(read(*at), law(*at), rtol=1e-5)
    np.testing.assert_allclose(read.dual_metric(at[0]), law.dual_metric(at[0]), rtol=1e-5)
    ends = np.linalg.eigvalsh(law.dual_metric(at[0]) / law.scaled.scale[:, None] / law.scaled.scale)
    assert ends.min() >= 0.1 * (1.0 - 1e-5)
    # At the target the control is that of the plan.
    np.testing.assert_array_equal(law(at[1], at[1], at[2]), at[2])
    env = TaskEnv(task=task)
    assert make("c3m", env, weights=path).name == "c3m"
    with pytest.raises(ValueError, match="states and"):
        make("c3m", TaskEnv(task=task_named("cartpole")), weights=path)
    heavy = replace(task, time_limit=12.0)
    with pytest.raises(ValueError, match="was made for"):
        C3mPolicy(heavy, path)
    assert C3mPolicy(heavy, path, allow_other_settings=True).settings.time_limit == 12.0
    text = bytearray(path.read_bytes())
    text[-3] ^= 1
    path.write_bytes(text)
    with pytest.raises(ValueError, match="damaged"):
        ContractionNetworks.load(path)
    with pytest.raises(ValueError, match="no networks of c3m"):
        ContractionNetworks.load(shipped_file(task, "lagros.safetensors"))


@pytest.mark.parametrize("name", LEARNED)
def test_the_record_of_what_is_shipped_is_what_its_networks_do(name):
    """Look at (H) anew: slopes of the flown loop by differences, fresh samples, no torch."""
    task = task_named(name)
    path = shipped_file(task, "c3m.safetensors")
    record = json.loads(path.with_suffix(".json").read_text())
    law = ContractionNetworks.load(path)
    region = BoxRegion(
        *(tuple(record["region"][part]) for part in ("low", "high", "error")),
        *(tuple(record["region"][part]) for part in ("control_low", "control_high")),
    )
    drawn = region.sample(np.random.default_rng(9), 300)
    unit, period = law.scaled.scale, task.control_period

    def after(at):
        control = law(at, drawn.nominal, drawn.nominal_control)
        return hold_step(task.system, at, control, period)

    step = 2e-3
    slopes = np.stack(
        [
            (after(drawn.state + step * unit * e) - after(drawn.state - step * unit * e))
            / (2 * step * unit)
            for e in np.eye(len(unit))
        ],
        axis=-1,
    )
    here = np.linalg.inv(law.dual_metric(drawn.state) / unit[:, None] / unit)
    ahead = np.linalg.inv(law.dual_metric(after(drawn.state)) / unit[:, None] / unit)
    # Of several settings that were tried, or the only ones.
    chosen = record.get("chosen", record["training"]["algorithm"])
    for rate, part in (
        (chosen["rate"], "closed"),
        (0.0, "closed_at_zero"),
    ):
        left = slopes.swapaxes(1, 2) @ ahead @ slopes - math.exp(-2 * rate * period) * here
        share = np.mean(np.linalg.eigvalsh(left)[:, -1] < 0.0)
        assert share == pytest.approx(record["conditions"][part], abs=0.12)
