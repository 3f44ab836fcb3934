"""Tasks of a user's own: how they are found, checked, registered and sent to other processes."""

import os
import pickle
import shlex
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs import Scenario, Task, find_task, register_task
from lagros_envs.check_task import check_task
from lagros_envs.registry import called, task_named, task_names
from lagros_envs.task import Feedback
from lagros_envs.tasks import SHIPPED

FILE = Path(__file__).parent / "files" / "puck.py"
PUCK = find_task(str(FILE))
Puck = type(PUCK)


@pytest.mark.parametrize("name", SHIPPED)
def test_what_is_shipped_is_registered_as_its_task_says(name):
    task, shipped = task_named(name), SHIPPED[name]
    assert (task.name, task.title) == (name, shipped.title)
    spec = gym.spec(task.env_id)
    # Where presets have limits of their own, Gymnasium is told none.
    assert spec.max_episode_steps == shipped.steps
    assert shipped.steps == (task.steps if task.most_agents == 1 else None)
    if isinstance(task, Task):
        check_task(task)


@pytest.mark.parametrize("text", ["{file}", "{file}:Puck", "{relative}", "{home}", "puck"])
def test_a_task_of_a_file_is_found_and_registered(text, monkeypatch):
    monkeypatch.chdir(FILE.parents[1])
    monkeypatch.setenv("HOME", str(FILE.parent))
    places = {"file": FILE, "relative": "./files/puck.py", "home": "~/puck.py"}
    found = find_task(text.format(**places))
    assert found == PUCK
    assert type(found) is Puck
    assert "puck" in task_names()
    assert gym.make("lagros/Puck-v0").unwrapped.settings == PUCK


@pytest.mark.parametrize("text", ["./puck.py", "puck.py:Puck", "{file}"])
def test_what_a_task_is_called_in_a_command_is_what_finds_it(text, monkeypatch, tmp_path):
    (tmp_path / "puck.py").write_text(FILE.read_text().replace('"puck", "Puck"', '"tin", "Tin"'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lagros_envs.registry._FOUND", {})
    monkeypatch.setattr("lagros_envs.registry._CALLED", {})
    task = find_task(text.format(file=tmp_path / "puck.py"))
    assert called(task) == text.format(file=tmp_path / "puck.py")
    # In a process that was only sent the task, the file is known by its class.
    monkeypatch.setattr("lagros_envs.registry._CALLED", {})
    (found,) = shlex.split(called(task))
    assert find_task(found) == task
    for name in SHIPPED:
        assert called(task_named(name)) == name


def write(folder, text):
    """Write a file whose text begins with that of the puck's."""
    path = folder / "own.py"
    path.write_text(FILE.read_text(encoding="utf-8") + text, encoding="utf-8")
    return path


def test_a_file_that_has_changed_is_read_again(tmp_path):
    path = write(tmp_path, "\n\ntask = Puck(rink=7.0)\n")
    path.write_text(path.read_text().replace('"puck", "Puck"', '"disc", "Disc"'))
    assert find_task(str(path)).rink == 7.0
    path.write_text(path.read_text().replace("rink=7.0", "rink=8.0"))
    os.utime(path, ns=(1, 1))
    assert find_task(str(path)).rink == 8.0
    assert gym.make("lagros/Disc-v0").unwrapped.settings.rink == 8.0


def test_a_task_of_a_module_is_found(tmp_path, monkeypatch):
    path = write(tmp_path, "\n\ndef made():\n    return Puck(rink=3.0)\n")
    path.write_text(path.read_text().replace('"puck", "Puck"', '"ring", "Ring"'))
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_task("own:made").rink == 3.0
    assert find_task("own:Puck").name == "ring"


def test_a_task_of_an_installed_package_is_found(tmp_path, monkeypatch):
    write(tmp_path, "").rename(tmp_path / "installed_puck.py")
    text = (tmp_path / "installed_puck.py").read_text().replace('"puck", "Puck"', '"slab", "Slab"')
    (tmp_path / "installed_puck.py").write_text(text)
    metadata = tmp_path / "installed-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: installed\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text("[lagros.tasks]\nslab = installed_puck:Puck\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_task("slab").title == "Slab"
    assert called(find_task("slab")) == "slab"
    assert "slab" in task_names()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cartpol", "unknown task 'cartpol'. Did you mean 'cartpole'. Valid: cartpole, "),
        ("nothing", r'the path of a file with a task, such as "./puck.py"; or "module:attribute"'),
        ("./nothing.py", "nothing.py': there is no such file"),
        ("json:nothing", "json:nothing: module 'json' has no attribute 'nothing'"),
        ("json:loads", r"json:loads: loads\(\) makes no task: TypeError"),
        ("math:pi", "math:pi is 3.14159.*; it must be a Task, a subclass"),
        ("no_such_module:x", 'No module named.*name a file by its path, such as "./puck.py"'),
        (f"{FILE}:Nothing", "puck.py has no attribute Nothing"),
    ],
)
def test_what_is_no_task_is_said_with_a_remedy(text, message):
    with pytest.raises(ValueError, match=message):
        find_task(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "\n\nclass Other(Puck):\n    name = 'other'\n",
            "has several tasks, Puck, Other; say which",
        ),
        ("\n\n1 / 0\n", r"own.py, line \d+: ZeroDivisionError"),
        ("\n\nraise SystemExit(3)\n", r"own.py, line \d+: SystemExit: 3"),
        ("\n\nclass Other(Puck):\n    name = None\n\n\ntask = Other()\n", "name=None must be set"),
        ("\n\ndef broken(\n", r"own.py, line \d+: SyntaxError"),
        ("\n\nimport no_such_module\n", r"own.py, line \d+: ModuleNotFoundError"),
        ("\n\ndel Puck\n", "own.py has no task: define a subclass of lagros_envs.Task"),
    ],
)
def test_a_file_that_holds_no_one_task_says_where(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        find_task(str(write(tmp_path, text)))


def test_a_task_of_a_file_reaches_a_process_that_has_never_seen_it(tmp_path, run_python):
    """By the pickles of the standard library, which `spawn` uses."""
    env = gym.make(PUCK.env_id, disturbance="uniform").unwrapped
    (tmp_path / "sent").write_bytes(pickle.dumps((PUCK, env)))
    script = f"""
import pickle
task, env = pickle.load(open({str(tmp_path / "sent")!r}, "rb"))
assert type(task).__name__ == "Puck" and task == env.settings
print(env.reset(seed=3)[0].tolist())
"""
    assert run_python(script).strip() == str(env.reset(seed=3)[0].tolist())


def test_what_lies_beside_the_file_of_a_task_can_be_imported(tmp_path, run_python):
    text = FILE.read_text().replace('"puck", "Puck"', '"lump", "Lump"')
    (tmp_path / "lump.py").write_text("import beside_the_lump\n" + text)
    (tmp_path / "beside_the_lump.py").write_text("")
    task = find_task(str(tmp_path / "lump.py"))
    (tmp_path / "sent").write_bytes(pickle.dumps(task))
    script = f"import pickle\nprint(pickle.load(open({str(tmp_path / 'sent')!r}, 'rb')).name)"
    assert run_python(script).strip() == "lump"
    assert sys.path[-1] == str(tmp_path)
    sys.path.remove(str(tmp_path))


def _first(task, seed):
    from lagros_envs.env import TaskEnv

    return TaskEnv("uniform", settings=replace(task, rink=6.0)).reset(seed=seed)[0]


def test_a_task_of_a_file_reaches_workers():
    joblib = pytest.importorskip("joblib")
    found = joblib.Parallel(2)(joblib.delayed(_first)(PUCK, seed) for seed in (1, 2))
    for one, seed in zip(found, (1, 2), strict=True):
        np.testing.assert_array_equal(one, _first(PUCK, seed))


def faulty(**changes):
    """Return a puck with attributes of its class replaced, under a name of its own."""
    changes = {"name": "faulty", "title": "Faulty", **changes}
    return type("Faulty", (Puck,), changes)()


def around(self, rng):
    """Draw from a generator of all."""
    return Scenario(np.random.default_rng().uniform(size=4), np.zeros(4))


def where_a_disc_is(self, rng):
    """Start in a disc."""
    return Scenario(np.zeros(4), np.array([3.0, 0.0, 0.0, 0.0]), np.array([[0.2, 0.0, 0.3]]))


@dataclass
class Mutable:
    """A system that cannot be hashed."""

    state_dim: int = 4
    control_dim: int = 2
    derivative = type(PUCK.system).derivative
    mass: float = 1.0


FAULTS = {
    "no name": ({"name": None}, "name=None must be set to a text like 'puck'"),
    "name": ({"name": "My puck"}, "name='My puck' must be set to a text like 'puck'"),
    "title": ({"title": "puck"}, "title='puck' must be set to a text like 'Puck'"),
    "unit": ({"state_names": ("x", "y", "vx", "vy")}, r"a name and its unit in brackets"),
    "names": ({"control_names": ("a [N]",)}, "must be 2 texts, one for each control"),
    "scale": ({"control_scale": (1.0,)}, r"control_scale=\(1.0,\) must be a tuple of 2 numbers"),
    "sign": ({"control_scale": (1.0, -1.0)}, r"control_scale\[1\]=-1.0 must be finite and > 0"),
    "order": ({"control_low": (4.0, 4.0)}, r"control_low\[0\]=4 must not be above control_high"),
    "place": ({"position": (0, 4)}, "position=.0, 4. must be different indices of states, 0 to 3"),
    "axes": ({"position": (0,)}, "position=.0,. must be two or three"),
    "space": ({"position": (0, 1, 2), "most_discs": 1}, "most_discs=1 needs position, the two"),
    "picture": ({"place": lambda task, state: state}, "place.state. has shape .4,."),
    "regulator": ({"regulator": Feedback((1.0,), (1.0,))}, "regulator.state_weights=.1.0,. must"),
    "flat": ({"position": ()}, "most_discs=3 needs position"),
    "room": ({"most_discs": 1}, "has 2 discs; an observation has room for most_discs=1"),
    "state": ({"state_high": (1.0,) * 4}, "is beyond state_high"),
    "random": ({"sample": around}, "two answers for one seed: draw from rng alone"),
    "nothing": ({"sample": lambda self, rng: None}, "returns None; it must return a Scenario"),
    "short": (
        {"sample": lambda self, rng: Scenario(np.zeros(3), np.zeros(4))},
        r"initial_state=\[0.0, 0.0, 0.0\] must be finite numbers of shape \(4,\)",
    ),
    "disc": ({"sample": where_a_disc_is}, "initial_state is 0.2 m from the centre of a disc"),
    "fallen": ({"rink": -1.0, "fallen": lambda self, x, f: x[0] > -9.0}, "has fallen already"),
    "number": ({"fallen": lambda self, x, f: x[0] * 0.0}, "must end with a comparison"),
    "branch": (
        {"fallen": lambda self, x, f: True if x[0] > 9.0 else x[0] > 8.0},
        "cannot be recorded.*branch",
    ),
    "library": (
        {"goal_distance": lambda self, x, g, f: float(np.hypot(x[0] - g[0], x[1] - g[1]))},
        "cannot be recorded",
    ),
    "defaults": ({"defaults": {"bound": 0.3}}, "defaults={'bound': 0.3} must be a Defaults"),
    "learning": ({"learning": 3}, "learning=3 must be a Learning, or None"),
    "weights": ({"weights": 3}, "weights=3 must be a Path or a str, or None"),
    "folder": ({"room": "puck"}, "room='puck' is a folder of this package"),
    "radius": ({"success_radius": lambda self, time: -1.0}, r"success_radius\(0\) is -1.0"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_task_is_refused_in_its_authors_words(fault):
    changes, message = FAULTS[fault]
    task = faulty(**changes)
    with pytest.raises((TypeError, ValueError), match=f"the task Faulty: .*{message}"):
        register_task(task)
    assert task.name not in task_names()


def test_a_system_that_cannot_be_hashed_is_refused():
    @dataclass(frozen=True)
    class Held(Puck):
        system: Mutable = field(default_factory=Mutable)

    with pytest.raises(TypeError, match=r"Mutable cannot be hashed.*@dataclass\(frozen=True\)"):
        register_task(Held())


def test_names_that_are_taken_are_refused():
    for changes in ({"name": "cartpole"}, {"title": "CartPole"}):
        with pytest.raises(ValueError, match="are taken by the task 'cartpole' of this package"):
            register_task(faulty(**changes))
    for changes in ({"name": "puck"}, {"title": "Puck"}):
        with pytest.raises(ValueError, match="are those of another task, "):
            register_task(faulty(**changes))
    assert register_task(PUCK) is PUCK
    with pytest.raises(TypeError, match="the class Puck is no task: register_task takes an inst"):
        register_task(Puck)


def test_a_call_of_an_environment_names_what_it_lacks():
    from lagros_envs.env import TaskEnv

    with pytest.raises(ValueError, match="pass the task, or the name"):
        TaskEnv()
    with pytest.raises(ValueError, match="unknown task 'nothing'"):
        TaskEnv(task="nothing")
