"""`lagros watch`: what is in the videos, what the command says, and what it leaves behind."""

from __future__ import annotations

import io
import itertools
import re
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report import video
from lagros_benchmarks.report.playback import Playback, WatchSettings
from lagros_benchmarks.report.watched import SinglePictures
from lagros_benchmarks.tasks.spacecraft import game
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_policies.baselines import LqrPolicy

pygame = pytest.importorskip("pygame")

PILOTS = '''
import numpy as np

from lagros_envs.tasks.spacecraft.sensing import Layout


class Pilot:
    """Pushes towards the goal and brakes; one row for each agent."""

    name, observes = "pilot", "local"

    def __init__(self, settings, preset):
        self.at = Layout.for_preset(preset, settings).slices
        self.calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert observation.ndim == 2
        assert episode_start.all() == (self.calls == 0)
        self.calls += 1
        part = {name: observation[:, where] for name, where in self.at.items()}
        push = 0.3 * part["goal"] - 1.0 * part["velocity"]
        cosine, sine = part["heading"][:, 0], part["heading"][:, 1]
        first = cosine * push[:, 0] - sine * push[:, 1]
        second = sine * push[:, 0] + cosine * push[:, 1]
        action = np.zeros((len(push), 8), np.float32)
        action[:, 4] = action[:, 5] = np.maximum(0.5 * first, 0.0)
        action[:, 0] = action[:, 1] = np.maximum(-0.5 * first, 0.0)
        action[:, 6] = action[:, 7] = np.maximum(0.5 * second, 0.0)
        action[:, 2] = action[:, 3] = np.maximum(-0.5 * second, 0.0)
        return action, self.calls

    def counters(self, state):
        return {"plans": state}


class Broken(Pilot):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if self.calls == 5:
            raise ArithmeticError("no way out")
        return super().predict(observation, state, episode_start, deterministic)


class Unbuilt(Pilot):
    def __init__(self):
        """Takes no settings."""


class Plan:
    def __init__(self, nominal):
        self.nominal = nominal


class Planner:
    """Stays where it is, and says that it will be one metre further on."""

    name, observes = "planner", "global"

    def __init__(self, settings, preset):
        self.steps, self.agents = settings.steps, preset.agents

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert observation.ndim == 2
        if state is None:
            x = observation[0, 1 : 1 + 6 * self.agents].reshape(1, self.agents, 6)
            nominal = np.repeat(x.astype(float), self.steps + 1, axis=0)
            nominal[..., 0] += 1.0
            state = [Plan(nominal)]
        return np.zeros((1, self.agents, 8), np.float32), state
'''


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    """Run the command in a folder that holds the policies of this file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "pilots.py").write_text(PILOTS)
    yield lambda *arguments: CliRunner().invoke(cli.app, ["watch", *map(str, arguments)])
    sys.modules.pop("pilots", None)


def frames_of(path):
    frames, durations = [], []
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return frames, durations


def crossing():
    return Scenario([[1.0, 1.0], [4.0, 4.0]], [0.3, 2.0], [[1.0, 2.0], [4.0, 3.0]], [[2, 3]], [0.5])


# The videos


def test_a_gif_shows_the_episode_at_the_speed_asked_for(invoke, tmp_path):
    result = invoke(
        *("spacecraft", "--policy", "pilots:Pilot", "--agents", 3, "--preset", "open"),
        *("--disturbance", "none", "--seed", 4, "--seconds", 6, "--speed", 3, "--video", "x.gif"),
    )
    assert result.exit_code == 0, result.output
    frames, durations = frames_of(tmp_path / "x.gif")
    # 6 s three times as fast, a frame for every second control step, and the last for a while.
    assert 1000 / max(durations[:-1]) >= video.FRAME_RATES[".gif"]
    assert sum(durations) / 1e3 == pytest.approx(6.0 / 3.0 + 1.5, abs=0.1)
    # The last frame is what the environment draws at that time.
    import pilots

    env = spacecraft_v0.parallel_env(3, "open", render_mode="rgb_array")
    observations, _ = env.reset(seed=4)
    pilot = pilots.Pilot(env.settings, env.preset)
    for step in range(60):
        rows = np.stack([observations[agent] for agent in env.agents])
        actions, _ = pilot.predict(rows, None, np.full(3, step == 0))
        observations, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        if step % 2 == 1:
            expected = env.render()
    env.close()
    assert len(frames) == 31
    wrong = np.abs(frames[-1].astype(int) - expected).max(axis=-1)
    assert np.mean(wrong > 24) < 0.01
    assert np.mean(np.abs(frames[0].astype(int) - expected).max(axis=-1) > 24) > 0.01


def test_an_mp4_has_the_frames_of_the_episode(invoke, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    result = invoke(
        *("spacecraft", "--policy", "pilots:Pilot", "--agents", 2, "--preset", "open"),
        *("--seconds", 2, "--speed", 1, "--video", "deep/x.mp4"),
    )
    assert result.exit_code == 0, result.output
    command = [ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "deep/x.mp4"]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run([*command, *raw], capture_output=True, check=True)
    assert b"840x640" in decoded.stderr
    assert b" 10 fps" in decoded.stderr
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 640, 840, 3)
    assert len(frames) == 21 + 15  # 2 s of ten frames, and 1.5 s of the last one
    assert np.abs(frames[0].astype(int) - frames[20]).max() > 100
    assert np.median(frames[0, :, -20:]) == pytest.approx(240, abs=4)  # of the panel
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["x.mp4"]


def test_the_cart_pole_is_filmed_too(invoke, tmp_path):
    result = invoke(
        *("cartpole", "--policy", "lqr", "--seconds", 1, "--speed", 1, "--video", "c.gif")
    )
    assert result.exit_code == 0, result.output
    assert "lqr on seed 0, uniform d̄ = 0.75: no success, not fallen" in result.output
    frames, _ = frames_of(tmp_path / "c.gif")
    assert frames[0].shape == (400, 800, 3)
    assert np.any(frames[0] != frames[-1])


def test_a_film_of_the_cart_pole_is_smooth_and_takes_its_time(invoke, tmp_path):
    result = invoke("cartpole", "--policy", "lqr", "--seconds", 3, "--video", "c.gif")
    assert result.exit_code == 0, result.output
    frames, durations = frames_of(tmp_path / "c.gif")
    # In real time, with one picture between two control instants; the last stays for 1.5 s.
    assert len(frames) == 61
    assert max(durations[:-1]) <= 50
    assert sum(durations) / 1e3 == pytest.approx(3.0 + 1.5, abs=0.1)
    moved = [np.any(first != second) for first, second in itertools.pairwise(frames)]
    assert all(moved)
    assert (tmp_path / "c.gif").stat().st_size < 1e6


def test_the_picture_between_two_control_instants_is_where_the_cart_pole_is():
    def cartpole(period):
        settings = CartPoleSettings(control_period=period, time_limit=4.5)
        env = gymnasium.make("lagros/CartPole-v0", settings=settings, render_mode="rgb_array")
        env.reset(
            seed=3,
            options={"nominal": np.outer(np.linspace(0.0, 1.0, settings.steps + 1), np.ones(4))},
        )
        return env.unwrapped

    halves, whole = cartpole(0.05), cartpole(0.1)
    halves.step(np.array([0.3]))
    pictures = SinglePictures(whole, "rgb_array", 10.0)
    pictures.hold(np.array([0.3]))
    whole.step(np.array([0.3]))
    np.testing.assert_array_equal(pictures.draw(0.5, np.zeros(4)), halves.render())
    halves.step(np.array([0.3]))
    np.testing.assert_array_equal(pictures.draw(1.0, np.zeros(4)), halves.render())
    pictures.close()


def test_a_drawing_keeps_its_areas_in_the_palette():
    rng = np.random.default_rng(0)
    areas = rng.integers(0, 256, (8, 3), np.uint8)
    pixels = np.repeat(areas, 500, axis=0)
    noise = rng.integers(0, 256, (3000, 3), np.uint8)
    palette = video.common_colours(np.concatenate([noise, pixels]))
    assert len(palette) <= 64
    assert len(np.unique(palette, axis=0)) == len(palette)
    for area in areas:
        assert np.any(np.all(palette == area, axis=1))


def test_what_stands_still_is_the_same_in_every_frame_of_a_gif():
    rng = np.random.default_rng(1)
    frames = np.full((5, 40, 60, 3), 248, np.uint8)
    frames[:, :20, :20] = [0, 114, 178]
    frames[:, 25:, 30:] = rng.integers(0, 256, (5, 15, 30, 3))
    stored, durations = frames_of(io.BytesIO(video.gif_bytes(iter(frames), 10.0)))
    assert durations == [100] * 5
    for frame, expected in zip(stored, frames, strict=True):
        np.testing.assert_array_equal(frame[:20, :20], expected[:20, :20])
    with pytest.raises(ValueError, match="no frame"):
        video.gif_bytes([], 10.0)


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_an_episode_that_breaks_is_shown_up_to_there(invoke, tmp_path, suffix):
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / f"x.{suffix}"
    target.write_text("old")
    result = invoke("spacecraft", "--policy", "pilots:Broken", "--agents", 2, "--video", target)
    assert result.exit_code == 3
    assert "which counts as a failure: ArithmeticError: no way out" in result.output
    assert "0 of 2 arrived" in result.output
    assert target.read_bytes()[:3] != b"old"
    assert list((tmp_path / "out").iterdir()) == [target]


def test_what_ffmpeg_says_is_passed_on(invoke, tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    script = tmp_path / "ffmpeg"
    script.write_text("#!/bin/sh\necho disk full >&2\nexit 3\n")
    script.chmod(0o755)
    monkeypatch.setattr(ffmpeg, "get_ffmpeg_exe", lambda: str(script))
    frames = iter(np.zeros((40, 64, 64, 3), np.uint8))
    with pytest.raises(OSError, match=r"could not make the film: disk full"):
        video.video_bytes(".mp4", frames, 10.0)


# The episode


def test_a_scenario_of_ones_own_is_played(invoke, tmp_path):
    crossing().save(tmp_path / "s.json")
    result = invoke(
        *("spacecraft", "--policy", "pilots:Pilot", "--scenario", "s.json", "--preset", "open"),
        *("--disturbance", "none", "--seconds", 20, "--speed", 40, "--video", "x.gif"),
    )
    assert result.exit_code == 0, result.output
    assert re.search(
        r"in s\.json, none: 2 of 2 arrived, 0 collided, in 20\.0 s; mean effort of an agent",
        result.output,
    )
    assert "plans 200" in result.output
    result = invoke(
        *("spacecraft", "--policy", "pilots:Pilot", "--scenario", "s.json", "--agents", 3),
        *("--video", "x.gif"),
    )
    assert result.exit_code == 2
    assert "agents=3 but s.json has 2" in result.output


def test_a_policy_that_plans_is_shown_with_its_plan(invoke, tmp_path):
    film = Playback(
        WatchSettings("spacecraft", policy="pilots:Planner", agents=2, video=tmp_path / "x.gif")
    )
    film._game.begin()
    film._game.open("rgb_array", 10.0)
    world = film._game.env.episode.world
    film._game.step()
    apart = world.nominal_now()[0, :, :2] - world.scenarios[0].starts
    np.testing.assert_allclose(apart, [[1.0, 0.0]] * 2, atol=1e-6)
    film.close()


def test_the_safety_filter_is_put_on(invoke, tmp_path, monkeypatch):
    from lagros_policies.policy import BasePolicy
    from lagros_policies.tasks.spacecraft import safety_filter as safety

    seen = {}

    class Filter(BasePolicy):
        def __init__(self, policy, settings, preset, disturbance_bound):
            seen.update(policy=policy, preset=preset, bound=disturbance_bound)

        def predict(self, observation, *rest):
            return np.zeros((len(observation), 8)), None

    monkeypatch.setattr(safety, "SafetyFilter", Filter)
    result = invoke(
        *("spacecraft", "--policy", "pilots:Pilot", "--agents", 2, "--bound", 0.7, "--seconds", 1),
        *("--safety-filter", "--video", "x.gif"),
    )
    assert result.exit_code == 0, result.output
    assert "mean effort of an agent 0.00 N²s" in result.output
    assert seen["bound"] == 0.7
    assert seen["preset"].agents == 2


# The window


def test_without_a_file_a_window_shows_it(invoke, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    arguments = ("spacecraft", "--policy", "pilots:Pilot", "--agents", 2, "--speed", 50)
    result = invoke(*arguments, "--seconds", 2)
    assert result.exit_code == 0, result.output
    assert "in 2.0 s" in result.output
    assert not pygame.display.get_init()


def test_closing_the_window_ends_the_episode(invoke, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    closing = game.SpacecraftGame.step

    def step(self):
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        return closing(self)

    monkeypatch.setattr(game.SpacecraftGame, "step", step)
    result = invoke("spacecraft", "--policy", "pilots:Pilot", "--agents", 2, "--speed", 50)
    assert result.exit_code == 0, result.output
    # It is asked after every frame: here, every twentieth control step.
    assert "in 2.0 s" in result.output


def test_where_no_window_opens_the_option_is_named(invoke, monkeypatch):
    def refuse():
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "init", refuse)
    result = invoke("spacecraft", "--policy", "pilots:Pilot", "--agents", 2)
    assert result.exit_code == 1
    assert "--video out.gif" in result.output


# Mistakes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cartpol",), "Did you mean 'cartpole'?"),
        (("spacecraft", "--video", "x.avi"), "must end in .gif or .mp4"),
        (("cartpole", "--speed", 0.04), "speed=0.04 must be between 0.05 and 1000"),
        (("spacecraft", "--speed", 1e9), "speed=1000000000.0 must be between 0.05 and 1000"),
        (("spacecraft", "--preset", "opn"), "Did you mean 'open'?"),
        (("spacecraft", "--agents", "0"), "agents=0 must be a whole number"),
        (("spacecraft", "--bound", "nan"), "bound=nan must be a finite number"),
        (("spacecraft", "--speed", "0"), "speed=0.0 must be finite and > 0"),
        (("spacecraft", "--seconds", "-1"), "seconds=-1.0 must be finite and > 0"),
        (("spacecraft", "--seed", "-1"), "seed=-1 must be"),
        (("spacecraft", "--disturbance", "worst"), "Valid: none, uniform, sphere"),
        (("spacecraft", "--scenario", "none.json"), "none.json"),
        (("cartpole", "--agents", "2"), "--agents is for worlds of many agents"),
        (("cartpole", "--safety-filter"), "--safety-filter is for worlds of many agents"),
        (("spacecraft", "--policy", "pilots:Nobody"), "pilots:Nobody"),
        (("cartpole", "--policy", "lqrr"), "Did you mean 'lqr'?"),
    ],
)
def test_a_mistake_is_explained_with_status_2(invoke, arguments, message):
    given = arguments if "--video" in arguments else (*arguments, "--video", "x.gif")
    result = invoke(*given)
    assert result.exit_code == 2
    assert message in result.output
    assert isinstance(result.exception, SystemExit)


def test_a_class_that_cannot_be_built_is_explained(invoke):
    result = invoke("spacecraft", "--policy", "pilots:Unbuilt", "--video", "x.gif")
    assert result.exit_code == 1
    assert "policy 'pilots:Unbuilt' cannot be built: TypeError: " in result.output
    assert isinstance(result.exception, SystemExit)


@pytest.mark.parametrize(
    ("module", "suffix", "extra"),
    [("imageio_ffmpeg", "mp4", "lagros[video]"), ("PIL", "gif", "lagros[bench]")],
)
def test_the_missing_extra_is_named_before_anything_is_played(
    invoke, monkeypatch, module, suffix, extra
):
    monkeypatch.setitem(sys.modules, module, None)
    result = invoke("spacecraft", "--policy", "pilots:Broken", "--video", f"x.{suffix}")
    assert result.exit_code == 1
    assert f'pip install "{extra}"' in result.output


def test_an_effort_says_what_it_is(invoke, monkeypatch):
    """To success, as the tables have it; to the end beside it where the episode went on."""
    options = ("--disturbance", "none", "--seconds", 4, "--speed", 20, "--video", "x.gif")
    result = invoke("cartpole", "--policy", "lqr", *options)
    env = gymnasium.make("lagros/CartPole-v0").unwrapped
    policy = LqrPolicy()
    observation, _ = env.reset(seed=0)
    efforts, arrived = [], None
    for _ in range(40):
        action, _ = policy.predict(observation)
        observation, _, _, _, info = env.step(action)
        efforts.append((40.0 * float(action[0])) ** 2 * 0.1)
        if info["success"] and arrived is None:
            arrived = len(efforts)
    to_success, to_end = sum(efforts[:arrived]), sum(efforts)
    said = f"effort to success {to_success:.2f} N²s, to the end {to_end:.2f} N²s"
    assert said in result.output
