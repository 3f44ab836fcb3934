"""`lagros train`: the curves of several seeds, what it prints and writes, what it refuses."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from rich.console import Console
from typer.testing import CliRunner

from lagros_benchmarks.commands import train as command
from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.report import canvas
from lagros_benchmarks.tasks.cartpole.course import CartPoleCourse
from lagros_benchmarks.tasks.spacecraft.course import SpacecraftTraining
from lagros_benchmarks.training import curves as curves_module
from lagros_benchmarks.training.course import lesson_of
from lagros_benchmarks.training.curves import curves_of, draw, range_confidence
from lagros_benchmarks.training.settings import Training
from lagros_benchmarks.training.table import final_table
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_policies.policy import make
from tests.benchmarks.tiny_training import ALGORITHMS, TINY, one_thread

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def threads():
    yield from one_thread()


# Curves


def fake_record(name, seed, values, correction=None):
    training = replace(TINY, algorithm=ALGORITHMS[name], seed=seed, largest_correction=correction)
    curve = {"steps": [192, 384], "seconds": [1.0, 2.0], "cpu_seconds": [1.0, 2.0]}
    figures = dict.fromkeys(("success", "strict", "reward", "effort"), values)
    record = json.loads(json.dumps(training.record()))
    return {"training": record, "curve": curve | figures, "final": [{"success": values[-1]}]}


def test_curves_hold_median_and_range_of_the_seeds(tmp_path):
    ours = [fake_record("ppo", seed, [0.1 * seed, 0.5]) for seed in (0, 4, 1, 3, 2)]
    other = [fake_record("td3", 0, [0.0, 1.0], correction=4.0)]
    curves = curves_of([*ours, *other], "a command")
    first, second = curves["curves"]
    assert (first["label"], second["label"]) == ("ppo", "residual, 4 N (td3)")
    assert first["seeds"] == [0, 4, 1, 3, 2]
    spread = first["figures"]["success"]
    assert spread["median"] == pytest.approx([0.2, 0.5])
    assert spread["least"] == pytest.approx([0.0, 0.5])
    assert spread["largest"] == pytest.approx([0.4, 0.5])
    assert first["confidence_of_range"] == 0.9375
    json.dumps(curves, allow_nan=False)
    assert draw(curves, tmp_path / "a.png").stat().st_size > 1000
    changed = fake_record("ppo", 7, [0.0, 0.0])
    changed["training"]["worlds"] = 9
    with pytest.raises(ValueError, match="differ in more than the seed"):
        curves_of([*ours, changed], "a command")
    # One run that is counted five times is no interval of five.
    with pytest.raises(ValueError, match=r"the seeds \[0, 4, 1, 3, 2, 4\]; give each of them once"):
        curves_of([*ours, ours[1]], "a command")
    with pytest.raises(ValueError, match="one task"):
        curves_of([], "a command")


@pytest.mark.parametrize("names", [["ppo", "sac", "td3"], ["td3", "ppo"], ["sac", "residual"]])
def test_an_agent_looks_as_in_the_figure_of_the_benchmark(names, tmp_path, monkeypatch):
    expected = {name: canvas.styles(["mine", name])[name] for name in names}
    drawn = []
    monkeypatch.setattr(curves_module, "save", lambda figure, _: drawn.append(figure))
    corrected = {"residual": ("ppo", 4.0)}
    records = []
    for name in names:
        algorithm, correction = corrected.get(name, (name, None))
        records.append(fake_record(algorithm, 0, [0.0, 1.0], correction))
    draw(curves_of(records, "a command"), tmp_path / "a.png")
    for panel in drawn[0].axes:
        colours = [line.get_color() for line in panel.get_lines()]
        assert colours == [expected[name].colour for name in names]
    assert drawn[0].axes[-1].get_xlabel() == "control steps [millions]"
    np.testing.assert_allclose(drawn[0].axes[0].get_lines()[0].get_xdata(), [192e-6, 384e-6])


def test_a_second_correction_is_told_apart_from_the_first(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(curves_module, "save", lambda figure, _: drawn.append(figure))
    records = [fake_record("ppo", 0, [0.0, 1.0], correction) for correction in (4.0, 2.0)]
    draw(curves_of(records, "a command"), tmp_path / "a.png")
    first, second = (line.get_color() for line in drawn[0].axes[0].get_lines())
    assert first == canvas.styles(["residual"])["residual"].colour
    assert second != first


def test_the_range_holds_the_median_as_often_as_it_says():
    draws = np.random.default_rng(0).exponential(size=(20_000, 5))
    held = np.mean((draws.min(axis=1) < np.log(2.0)) & (draws.max(axis=1) > np.log(2.0)))
    assert held == pytest.approx(range_confidence(5), abs=0.006)
    with pytest.raises(ValueError, match="runs=0"):
        range_confidence(0)


# The command


def test_the_command_trains_several_runs_and_draws_them(tmp_path, monkeypatch):
    tiny = {"ppo": TINY, "td3": replace(TINY, algorithm=ALGORITHMS["td3"])}
    monkeypatch.setattr(CartPoleCourse, "trainings", lambda *_: tiny)
    arguments = ["train", "cartpole", "--algo", "ppo,td3", "--seed", "0,1", "--segments", "1"]
    files = ["--json", str(tmp_path / "a.json"), "--figure", str(tmp_path / "a.png")]
    out = ["--out", str(tmp_path / "runs")]
    result = CliRunner().invoke(app, [*arguments, *out, *files])
    assert result.exit_code == 0, result.output
    curves = json.loads((tmp_path / "a.json").read_text())["curves"]
    assert [(curve["label"], curve["seeds"]) for curve in curves] == [
        ("ppo", [0, 1]),
        ("td3", [0, 1]),
    ]
    record = json.loads((tmp_path / "runs/cartpole-td3/seed-1/record.json").read_text())
    assert record["command"] == "lagros train cartpole --algo td3 --seed 1 --segments 1"
    assert (tmp_path / "a.png").exists()
    # The same again: nothing is trained.
    monkeypatch.setattr(
        "lagros_benchmarks.training.run.make_agent", lambda *_: pytest.fail("again")
    )
    assert CliRunner().invoke(app, [*arguments, *out, *files]).exit_code == 0


@pytest.mark.parametrize("name", ["cartpole_sac", "spacecraft_ppo"])
def test_the_figures_at_the_end_fit_a_terminal(name):
    record = json.loads((ROOT / "lagros_policies" / "pretrained" / f"{name}.json").read_text())
    stream = io.StringIO()
    Console(file=stream, width=80).print(final_table(record))
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in stream.getvalue()
    shown = lines[-len(record["final"]) :]
    for line, row in zip(shown, record["final"], strict=True):
        assert line.startswith("none" if not row["bound"] else f"uniform {row['bound']:g}")
        assert f" {100 * row['success']:.1f} (" in line
        assert f" {row['effort_to_success']:.3g} " in line


def test_the_folder_of_a_run_names_what_it_is(tmp_path):
    corrected = replace(TINY, largest_correction=2.5, seed=3)
    assert command.folder_of(TINY, tmp_path) == tmp_path / "cartpole-ppo" / "seed-0"
    expected = tmp_path / "cartpole-residual-ppo-2.5N" / "seed-3"
    assert command.folder_of(corrected, tmp_path) == expected
    assert command.folder_of(SpacecraftTraining(), tmp_path).parts[-2:] == (
        "spacecraft-ppo",
        "seed-0",
    )
    elsewhere = SpacecraftTraining().in_worlds("gcbf", None)
    assert command.folder_of(elsewhere, tmp_path).parts[-2:] == ("spacecraft-ppo-gcbf-8", "seed-0")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["cartpole", "--algo", "trpo"], "Use one of ppo, sac, td3, c3m, missing"),
        (["spacecraft", "--algo", "sac"], "not known for spacecraft"),
        (["rocket"], "Valid: cartpole, spacecraft"),
        (["cartpole", "--seed", "-1"], "seed=-1"),
        (["cartpole", "--seed", "a"], "'a' is not a whole number"),
        (["cartpole", "--seed", ""], "it is empty"),
        (["cartpole", "--seed", "0,1,0"], "--seed names a run twice"),
        (["cartpole", "--algo", "ppo,,ppo"], "--algo: an entry is empty"),
        (["cartpole", "--segments", "0"], "segments=0"),
        (["cartpole", "--parallel-env"], "for many agents"),
        (["cartpole", "--agents", "3"], "for many agents"),
        (["spacecraft", "--residual", "3"], "for one body"),
        (["spacecraft", "--preset", "gcfb"], "preset='gcfb'"),
        (["spacecraft", "--preset", "gcbf", "--agents", "0"], "agents=0"),
        (["cartpole", "--residual", "-3"], "--residual=-3.0"),
        (["cartpole", "--residual", "1e9"], "more than the actuator's 40 N"),
        (["cartpole", "--figure", "a.txt"], "must end in"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["train", *arguments])
    assert result.exit_code == 2
    assert text in result.output
    assert not list(tmp_path.iterdir())


def test_a_task_that_is_not_known_has_no_lesson():
    with pytest.raises(ValueError, match="unknown task ''"):
        lesson_of(Training())


# The documentation


def test_the_class_in_the_documentation_is_a_row_of_the_benchmark(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "baselines.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    plain, normalised, agent = (
        next(block for block in blocks if word in block)
        for word in ('model.save("ppo.zip")', "np.savez", "class Mine")
    )
    # The imports and the worlds of the first, the training of the second, cut short.
    head = plain[: plain.index("model = PPO(")]
    program = (head + normalised).replace("350_000", "64").replace("n_steps=90", "n_steps=1")
    program = program.replace("batch_size=1440", "batch_size=64")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names: dict[str, object] = {}
    exec(program, names)
    (tmp_path / "my_agent.py").write_text(agent)
    out = ["--episodes", "1", "--timing-episodes", "1", "--json", "rows.json"]
    given = ["bench", "cartpole", "--policies", "my_agent:Mine", *out]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "rows.json").read_text())[0]["errors"] == []
    # It sees what the agent saw in its training.
    observation = np.random.default_rng(0).normal(size=(7, 13)).astype(np.float32)
    policy = make("my_agent:Mine", CartPoleEnv())
    expected, _ = names["model"].predict(
        names["venv"].normalize_obs(observation), deterministic=True
    )
    np.testing.assert_allclose(policy.predict(observation)[0], expected, atol=1e-5)
