"""`lagros new` and `lagros check` as a user runs them, with every kind of fault planted."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_envs import registry
from lagros_envs.registry import find_task
from lagros_envs.tasks import SHIPPED


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_FOUND", dict(registry._FOUND))
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, [*map(str, arguments)])


# lagros new


@pytest.mark.parametrize("options", [(), ("--discs",)])
def test_a_new_file_is_short_and_everything_runs_on_it(options, invoke):
    result = invoke("new", "my_boat.py", *options)
    assert result.exit_code == 0, result.output
    assert "lagros check ./my_boat.py" in result.stdout
    lines = len(Path("my_boat.py").read_text().splitlines())
    print(f"lagros new {' '.join(options)}: {lines} lines")  # noqa: T201 - shown by pytest -rP
    assert lines < 80
    task = find_task("./my_boat.py")
    assert (task.name, task.title) == ("my_boat", "MyBoat")
    assert type(task).__name__ == "MyBoatTask"
    assert bool(task.most_discs) == bool(options)
    result = invoke("check", "./my_boat.py", "--episodes", 3, "--json", "c.json")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("my_boat is ready: nothing is wrong in 11 checks.")
    record = json.loads(Path("c.json").read_text())
    assert (record["faults"], record["warnings"]) == (0, 0)
    assert {one["verdict"] for one in record["findings"]} == {"ok"}
    result = invoke("bench", "./my_boat.py", "--episodes", 3, "--json", "b.json")
    assert result.exit_code == 0, result.output
    rows = {row["policy"]: row for row in json.loads(Path("b.json").read_text())}
    assert rows["tube-mpc"]["success_rate"] == 1.0
    result = invoke("certify", "./my_boat.py", "--episodes", 2)
    assert result.exit_code == 0, result.output
    assert "guaranteed for 2 of 2 episodes" in result.stdout


def test_a_name_gives_the_names_in_the_file(invoke):
    for file, name, title in (
        ("two-masses_2.py", "two-masses_2", "TwoMasses2"),
        ("x.py", "x", "X"),
    ):
        assert invoke("new", file).exit_code == 0
        found = find_task(f"./{file}")
        assert (found.name, found.title) == (name, title)
    Path("sub").mkdir()
    result = invoke("new", "sub/feedback.py")
    assert "lagros check sub/feedback.py" in result.stdout
    assert find_task("sub/feedback.py").title == "Feedback"


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("there.py", "there.py exists, and is left as it is"),
        ("link.py", "link.py exists, and is left as it is"),
        ("folder.py", "folder.py exists"),
        ("Boat.py", "'Boat' cannot be the name of a task: begin with a small letter"),
        ("2boats.py", "cannot be the name of a task"),
        ("my boat.py", "cannot be the name of a task"),
        ("import.py", "'import' cannot be the name of a task"),
        ("boat.txt", "boat.txt must end in .py"),
        ("cart-pole.py", "'cart-pole' is a task of this package; choose another name"),
        ("none/boat.py", "there is no folder none"),
    ],
)
def test_what_cannot_be_written_is_refused(file, message, invoke):
    Path("there.py").write_text("mine\n")
    Path("link.py").symlink_to("nowhere.py")
    Path("folder.py").mkdir()
    result = invoke("new", file)
    assert result.exit_code == 2
    assert message in result.stderr
    assert Path("there.py").read_text() == "mine\n"
    assert not Path("nowhere.py").exists()
    assert sorted(path.name for path in Path().iterdir()) == ["folder.py", "link.py", "there.py"]


@pytest.mark.parametrize("name", SHIPPED)
def test_no_new_file_takes_the_name_of_a_shipped_task(name, invoke):
    result = invoke("new", f"{name}.py")
    assert result.exit_code == 2
    assert "is a task of this package" in result.stderr


# lagros check: what is changed in a new file, and what is then said of what

RATES = "return vx, vy, (fx - self.drag * vx) / self.mass, (fy - self.drag * vy) / self.mass"
UNMOVED = "return vx, vy, (fx - self.drag * vx) / self.mass, 0.0 * fy"
METRIC = (
    "metric = MetricDesign((-9.0,) * 4, (9.0,) * 4, (1.0,) * 4, (-4.0,) * 2, (4.0,) * 2{})\n"
    "    feedback = "
)
FAULTS = {
    "dimensions": (
        {RATES: "return vx, vy, fx"},
        ("fault", "description", "returns 3 rates", "correct this first"),
    ),
    "names": (
        {'("fx [N]", "fy [N]")': '("fx [N]",)'},
        ("fault", "description", "must be 2 texts, one for each control", "correct this first"),
    ),
    "no names": (
        {'    control_names = ("fx [N]", "fy [N]")\n': ""},
        ("warning", "names and units", "without control_names", "write state_names = "),
    ),
    "units": (
        {'"vx [m/s]"': '"vx [km/h]"'},
        ("warning", "names and units", "dx/dt = vx, so vx is in m/s, and not in km/h", "convert"),
    ),
    "degrees": (
        {'"vx [m/s]"': '"vx [deg]"'},
        ("warning", "names and units", "vx is in degrees", "use radians"),
    ),
    "energy rises": (
        {"(fx - self.drag": "(fx + self.drag"},
        ("fault", "energy", "it changes by ", "look for a wrong sign"),
    ),
    "energy falls": (
        {"    dissipates = True\n": ""},
        ("fault", "energy", "it changes by -", "say dissipates = True"),
    ),
    "energy fails": (
        {"return 0.5 * self.mass * (vx**2 + vy**2)": "return float(vx)"},
        ("fault", "energy", "MyBoatSystem.energy fails", "like the equation"),
    ),
    "mirror": (
        {
            "    dissipates = True\n": "    dissipates = True\n    mirror = (-1,) * 4, (-1, 1)\n",
        },
        ("fault", "mirror", "the mirror image has another dvy/dt", "look for a wrong sign"),
    ),
    "mirror signs": (
        {"    dissipates = True\n": "    dissipates = True\n    mirror = (2,) * 4, (-1, 1)\n"},
        ("fault", "mirror", "must be two tuples of 1 and -1", "give signs alone"),
    ),
    "hold": (
        {"drag: float = 0.2": "drag: float = 400.0"},
        ("fault", "hold", "of the scale of v", "shorten control_period (to 0.025 s, say)"),
    ),
    "plans": (
        {"control_low, control_high = (-4.0, -4.0), (4.0, 4.0)": "control_low, control_high = "
         "(-0.01, -0.01), (0.01, 0.01)"},
        ("fault", "plans", "0 of 3 random episodes have a plan", "give more time (time_limit)"),
    ),
    "controllability": (
        {RATES: UNMOVED},
        ("fault", "controllability", "no control moves +1.00 y", "give it a control"),
    ),
    "regulator": (
        {RATES: UNMOVED},
        ("warning", "regulator", "no regulator about the goal", "leave lqr out"),
    ),
    "weak": (
        {RATES: RATES.replace("(fy ", "(0.001 * fy ")},
        ("warning", "controllability", "+0.98 vy, moves by 0.01", "give more time or control"),
    ),
    "limits": (
        {"control_scale = (4.0, 4.0)": "control_scale = (0.05, 4.0)"},
        ("warning", "limits", "in units of control_scale", "set control_scale to about"),
    ),
    "saturation": (
        {
            "rng.uniform(-3.0, 3.0, (2, 2))": "rng.uniform((-3.0, -0.1), (-2.9, 0.1), (2, 2))\n"
            "        ends[1, 0] += 5.4",
            "control_low, control_high = (-4.0, -4.0), (4.0, 4.0)": "control_low, control_high = "
            "(-0.75, -4.0), (0.75, 4.0)",
        },
        ("warning", "limits", "% of the time at a limit", "widen control_low"),
    ),
    "rules": (
        {"    def sample": "    def excess(self, state, functions):\n"
         "        return abs(state[2]) + abs(state[3]) - 0.05\n\n    def sample"},
        ("fault", "flights", "without disturbance 0 of 3", "see that fallen, excess"),
    ),
    "large bound": (
        {"bounds=(0.2,), bound=0.2": "bounds=(2.0,), bound=2.0"},
        ("warning", "disturbance", "at d̄ = 2", "set defaults.bound and defaults.bounds to 0.25"),
    ),
    "small bound": (
        {"bounds=(0.2,), bound=0.2": "bounds=(1e-4,), bound=1e-4"},
        ("warning", "disturbance", "so nothing is tested", "raise defaults.bound"),
    ),
    "no metric": (
        {RATES: UNMOVED, "    feedback = ": "    " + METRIC.format("")},
        ("fault", "metric", "there is none as described", "lower the rate"),
    ),
    "basis": (
        {"    feedback = ": "    " + METRIC.format(', basis=("tanh(x[0])",)')},
        ("fault", "metric", "its description: ", "add functions to the basis"),
    ),
    "features": (
        {"    feedback = ": "    learning = Learning()\n    features = lambda self, x, functions: "
         "[functions.tanh(x[0])]\n    feedback = "},
        ("fault", "networks", "features fail", "write them as a function"),
    ),
    "scheduled": (
        {"    feedback = ": "    learning = Learning(scheduled=True)\n    feedback = "},
        ("fault", "networks", "the features are not affine in the state", "leave scheduled out"),
    ),
    "proof": (
        {"    def sample": "    def excess(self, state, functions):\n"
         "        return functions.sqrt(state[0] ** 2 - state[0] * state[0]) - 1.0\n\n"
         "    def sample"},
        ("warning", "proof", "fallen does not run on intervals", "joined by & and |"),
    ),
    "raises": (
        {"    def sample": "    def success_radius(self, time):\n"
         "        return 0.3 if time in (0.0, 6.0) else 1 / 0\n\n    def sample"},
        ("fault", "disturbance", "ZeroDivisionError", "correct what raises"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_and_said_with_a_remedy(fault, invoke):
    changes, (verdict, subject, said, remedy) = FAULTS[fault]
    assert invoke("new", "my_boat.py").exit_code == 0
    text = (
        Path("my_boat.py")
        .read_text()
        .replace("import Defaults, Feedback,", "import Defaults, Feedback, Learning, MetricDesign,")
    )
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    Path("my_boat.py").write_text(text)
    result = invoke("check", "./my_boat.py", "--episodes", 3, "--json", "c.json")
    record = json.loads(Path("c.json").read_text())
    findings = [one for one in record["findings"] if one["subject"] == subject]
    assert any(one["verdict"] == verdict and said in one["text"] for one in findings), findings
    assert any(remedy in one["remedy"] for one in findings), findings
    assert result.exit_code == (1 if record["faults"] else 0), result.output
    assert record["faults"] >= (verdict == "fault")
    first = result.stdout.splitlines()[0]
    assert first == record["verdict"]
    assert ("NOT ready" in first) == bool(record["faults"])
    # What is wrong comes before what is not.
    shown = [line.split()[0] for line in result.stdout.splitlines() if re.match(r" \w", line)]
    assert shown == sorted(shown, key=["fault", "warning", "ok"].index)
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("./none.py",), "there is no such file; `lagros new ./none.py` writes one"),
        (("spacecraft",), "spacecraft is a world of many agents; lagros check is for one body"),
        (("cartpole", "--episodes", 0), "--episodes: "),
        (("cartpole", "--json", "."), "--json"),
    ],
)
def test_what_cannot_be_checked_is_refused(arguments, message, invoke):
    result = invoke("check", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr


def test_a_file_that_cannot_be_read_is_a_fault(invoke):
    Path("broken.py").write_text("def broken(\n")
    result = invoke("check", "broken.py")
    assert result.exit_code == 1
    assert result.stdout.startswith("broken.py is NOT ready: 1 fault.")
    assert "SyntaxError" in result.stdout
