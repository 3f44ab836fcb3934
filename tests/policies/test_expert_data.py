"""Algorithm 1's data: what they are, and that nothing which interrupts them changes them."""

import os
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import save_metric
from lagros_policies.learning.dataset import ExpertDataSettings, generate
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.region import Region

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = ExpertDataSettings(plans=8, samples=160, shards=4, disturbance_bound=0.8, seed=5)


@pytest.fixture(scope="module")
def folder(metric, tmp_path_factory):
    """Return the shards of an uninterrupted run in one process."""
    folder = tmp_path_factory.mktemp("data")
    generate(folder, metric, SETTINGS)
    return folder


@pytest.fixture(scope="module")
def data(folder, metric):
    return generate(folder, metric, SETTINGS)


def same(one, other):
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for field in fields(one)
    )


def shards(folder):
    return sorted(folder.glob("shard*"))


def steps_of(data):
    return np.rint(data.observation[:, task.TIME] / 0.1).astype(int)


def test_every_plan_and_sample_is_there(data, folder):
    assert data.observation.shape == (160, 13)
    assert data.control.shape == (160, 1)
    assert data.plan.shape == (160,)
    assert data.plan_states.shape == (8, 91, 4)
    assert data.plan_controls.shape == (8, 90, 1)
    # Forty samples of each shard's two plans.
    assert np.array_equal(np.unique(data.plan), np.arange(8))
    assert np.array_equal(data.plan // 2, np.repeat(np.arange(4), 40))
    assert data.drawn >= 160
    assert len(shards(folder)) == 4


def test_plans_are_those_of_the_planner(data, oracle):
    following = oracle.step(data.plan_states[:, :-1], data.plan_controls)
    assert np.max(np.abs(following - data.plan_states[:, 1:])) < 1e-6
    assert np.all(data.plan_states[:, 0, [0, 2, 3]] == 0.0)
    assert np.all(np.abs(data.plan_states[:, 0, 1]) <= np.pi / 3)
    assert data.plan_states[:, -1, 1:] == pytest.approx(np.zeros((8, 3)), abs=1e-6)
    assert len(np.unique(data.plan_states[:, -1, 0])) == 8


def test_gains_are_the_slopes_of_the_law(data, metric):
    expert = CartPoleExpert(metric)
    tracked = expert.track(data.plan_states, data.plan_controls)
    state, step = data.observation[:, task.STATE], steps_of(data)
    way, slope = data.moves(CartPoleSettings(), np.random.default_rng(0))
    assert way.shape == state.shape
    assert np.all(np.any(way != 0.0, axis=1))
    ends = [expert.control(tracked, data.plan, step, state + end * way) for end in (1e-3, -1e-3)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-3, atol=1e-6)
    # As large as the errors are.
    error = state - data.plan_states[data.plan, step]
    np.testing.assert_allclose(way.std(axis=0), error.std(axis=0), rtol=0.3)


def test_no_slope_is_learned_where_the_label_is_not_the_linear_law(data):
    control = data.control.copy()
    control[::2] += 1.0
    way, slope = replace(data, control=control).moves(CartPoleSettings(), np.random.default_rng(0))
    assert not way[::2].any()
    assert not slope[::2].any()
    assert way[1::2].any(axis=1).all()
    with pytest.raises(ValueError, match="no linear gain"):
        replace(data, gain=data.gain[..., :0]).moves(CartPoleSettings(), np.random.default_rng(0))


def test_observations_are_what_the_environment_shows(data):
    steps = steps_of(data)
    assert data.observation[:, task.TIME] == pytest.approx(0.1 * steps)
    assert steps.min() >= 0
    assert steps.max() <= 89
    assert np.array_equal(data.observation[:, task.GOAL], data.plan_states[data.plan, -1])
    assert np.array_equal(data.observation[:, task.INITIAL_STATE], data.plan_states[data.plan, 0])


def test_samples_lie_in_the_region_and_off_the_plan(data, metric):
    steps = steps_of(data)
    nominal = data.plan_states[data.plan, steps]
    control = data.plan_controls[data.plan, steps]
    state = data.observation[:, task.STATE]
    assert np.all(metric.region.contains(state, nominal, control))
    distance = np.linalg.norm(state - nominal, axis=1)
    assert np.all(distance[steps == 0] == 0.0)
    assert np.median(distance[steps > 0]) > 0.01
    # A tube that begins with radius zero: one step of disturbance, and one more around it.
    assert distance[steps == 1].max(initial=0.0) < 2.0 * 0.8 * 0.1 * 1.5


def test_labels_are_the_expert_control(data, metric):
    expert = CartPoleExpert(metric)
    tracked = expert.track(data.plan_states, data.plan_controls)
    state = data.observation[:, task.STATE]
    expected = expert.control(tracked, data.plan, steps_of(data), state)
    # Each shard tracked its own two plans: the sums run in another order.
    assert data.control == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert np.abs(data.control - data.plan_controls[data.plan, steps_of(data)]).max() > 0.5


def test_nominal_pairs_are_the_plans_step_by_step(data):
    observation, control, plan = data.nominal_pairs(CartPoleSettings())
    assert np.array_equal(plan, np.repeat(np.arange(8), 90))
    assert observation.shape == (8 * 90, 13)
    row = 0
    for states, controls in zip(data.plan_states, data.plan_controls, strict=True):
        for step in range(90):
            expected = np.concatenate([states[step], states[-1], states[0], [0.1 * step]])
            assert observation[row] == pytest.approx(expected)
            assert control[row] == controls[step]
            row += 1


def test_rejected_states_are_counted_and_kept_out(metric, tmp_path):
    narrow = Region(
        angle=1.15, angular_rate=4.0, angle_error=0.02, angular_rate_error=0.1, force=40.0
    )
    few = ExpertDataSettings(plans=3, samples=60, shards=1, disturbance_bound=0.8)
    data = generate(tmp_path, replace(metric, region=narrow), few)
    assert data.drawn > 1.5 * 60
    error = data.observation[:, 1] - data.plan_states[data.plan, steps_of(data), 1]
    assert np.abs(error).max() <= 0.02


def test_region_that_nothing_reaches_is_an_error_with_advice(metric, tmp_path):
    tiny = Region(angle=1e-9, angular_rate=4.0)
    with pytest.raises(ValueError, match="larger region"):
        generate(tmp_path, replace(metric, region=tiny), ExpertDataSettings(1, 5, 1))


def test_data_do_not_depend_on_what_was_there_before(metric, data, folder, tmp_path):
    done = []
    again = generate(tmp_path, metric, SETTINGS, on_shard=done.append)
    assert done == list(range(5))
    assert same(again, data)
    for mine, theirs in zip(shards(tmp_path), shards(folder), strict=True):
        assert mine.read_bytes() == theirs.read_bytes()
    # Finished work is read, not repeated.
    stamps = [path.stat().st_mtime_ns for path in shards(tmp_path)]
    done.clear()
    assert same(generate(tmp_path, metric, SETTINGS, on_shard=done.append), data)
    assert done == [4]
    assert stamps == [path.stat().st_mtime_ns for path in shards(tmp_path)]


def test_another_seed_gives_other_data(metric, data, tmp_path):
    other = generate(tmp_path, metric, ExpertDataSettings(2, 10, 1, seed=6))
    assert not np.any(np.isin(other.plan_states[:, 0, 1], data.plan_states[:, 0, 1]))


def test_shards_of_one_run_share_no_episode(data):
    assert len(np.unique(data.plan_states[:, 0, 1])) == 8


def test_two_processes_give_what_one_gives(metric, data, folder, tmp_path):
    assert same(generate(tmp_path, metric, SETTINGS, jobs=2), data)
    for mine, theirs in zip(shards(tmp_path), shards(folder), strict=True):
        assert mine.read_bytes() == theirs.read_bytes()


INTERRUPTED = """
import os
import sys
from pathlib import Path
from lagros_policies.contraction import load_metric
from lagros_policies.learning.dataset import ExpertDataSettings, generate

def report(done):
    print(done, flush=True)
    if done == 3:
        sys.stdin.readline()  # go no further: the shards that are missing stay missing

def stuck(descriptor, counted=[]):
    counted.append(descriptor)
    if len(counted) == 3:  # the manifest, the first shard, and now the second
        print("writing", flush=True)
        sys.stdin.readline()

if sys.argv[3] == "write":
    os.fsync = stuck

if __name__ == "__main__":
    settings = ExpertDataSettings(
        plans=8, samples=160, shards=4, disturbance_bound=0.8, seed=5
    )
    folder, metric = Path(sys.argv[1]), load_metric(sys.argv[2])
    generate(folder, metric, settings, jobs=1, on_shard=report)
"""


@pytest.mark.parametrize("where", ["work", "write"])
def test_kill_loses_no_finished_shard_and_the_rest_is_made_again(
    metric, data, folder, tmp_path, where
):
    save_metric(metric, tmp_path / "metric.json")
    target = tmp_path / "data"
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(target), str(tmp_path / "metric.json"), where],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    awaited = "1" if where == "work" else "writing"
    with process:
        for line in process.stdout:
            if line.strip() in (awaited, "3"):
                break
        if where == "work":
            time.sleep(0.02)  # into the second shard
        process.kill()
        process.wait()
    assert line.strip() == awaited
    finished = {path.name: path.stat().st_mtime_ns for path in shards(target)}
    assert len(finished) == 1 if where == "write" else 1 <= len(finished) <= 3
    for name in finished:
        assert (target / name).read_bytes() == (folder / name).read_bytes()
    done = []
    assert same(generate(target, metric, SETTINGS, on_shard=done.append), data)
    assert done[0] == len(finished)
    for path in shards(target):
        assert path.read_bytes() == (folder / path.name).read_bytes()
        assert finished.get(path.name, path.stat().st_mtime_ns) == path.stat().st_mtime_ns


def test_half_written_file_is_not_taken_for_a_shard(metric, data, folder, tmp_path):
    # What a kill in the middle of a write leaves.
    generate(tmp_path, metric, SETTINGS)
    victim = shards(tmp_path)[2]
    content = victim.read_bytes()
    victim.unlink()
    (tmp_path / f".{victim.name}.12345.tmp").write_bytes(content[: len(content) // 2])
    assert same(generate(tmp_path, metric, SETTINGS), data)
    assert victim.read_bytes() == content


def changed_task(metric, settings):
    return metric, settings, CartPoleSettings(goal_range=4.0)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda m, s: (m, replace(s, seed=6), None), id="seed"),
        pytest.param(lambda m, s: (m, replace(s, samples=320), None), id="samples"),
        pytest.param(lambda m, s: (m, replace(s, disturbance_bound=0.7), None), id="bound"),
        pytest.param(changed_task, id="task"),
        pytest.param(
            lambda m, s: (replace(m, coefficients=1.01 * m.coefficients), s, None), id="metric"
        ),
        pytest.param(
            lambda m, s: (replace(m, contraction_rate=0.9 * m.contraction_rate), s, None), id="rate"
        ),
        pytest.param(lambda m, s: (replace(m, region=Region()), s, None), id="region"),
    ],
)
def test_folder_of_other_settings_is_refused_and_left_alone(metric, data, folder, change):
    stamps = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    other, settings, task_settings = change(metric, SETTINGS)
    with pytest.raises(ValueError, match=folder.name):
        generate(folder, other, settings, task_settings)
    assert stamps == {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert same(generate(folder, metric, SETTINGS), data)


@pytest.mark.parametrize("cut", [100, -100, 0])
def test_damaged_shard_is_named_and_made_again(metric, tmp_path, cut, caplog):
    few = ExpertDataSettings(plans=2, samples=4, shards=2)
    whole = generate(tmp_path, metric, few)
    victim = shards(tmp_path)[1]
    content = victim.read_bytes()
    victim.write_bytes(content[:cut] or b"x" * 500)
    assert same(generate(tmp_path, metric, few), whole)
    assert victim.read_bytes() == content
    assert victim.name in caplog.text


@pytest.mark.parametrize("text", ["", "{", "\xff", "[" * 100_000])
def test_damaged_manifest_is_named(metric, tmp_path, text):
    few = ExpertDataSettings(plans=2, samples=4, shards=2)
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=r"manifest.json .*; name another folder or remove"):
        generate(tmp_path, metric, few)


@pytest.mark.parametrize(
    "bad",
    [
        {"shards": 3},
        {"shards": 0},
        {"samples": 0},
        {"plans": 0},
        {"disturbance_bound": -0.1},
        {"spread": -1.0},
    ],
)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))}="):
        ExpertDataSettings(**{"plans": 8, "samples": 160, "shards": 4, **bad})
