"""`lagros new`: the file of a system of one's own, which runs as it is written."""

from __future__ import annotations

import keyword
import re
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from lagros_benchmarks.commands.terminal import fail

_NAME = re.compile(r"[a-z][a-z0-9_-]*")

_HEAD = '''"""$title: from a start to a goal$among, under bounded disturbance.

What to do with this file:

    lagros check $file      # what is wrong, in your words
    lagros bench $file      # policies on the same episodes
    lagros watch $file --policy tube-mpc --video $name.gif
    lagros certify $file    # what is proved of each flight
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.task import Defaults, Feedback, Scenario, Task


@dataclass(frozen=True)
class ${title}System:
    """A mass in the plane under two forces, with drag: put your equation of motion here."""

    # Constants are fields; gym.make(..., settings={...}) and a user of your class may change them.
    mass: float = 1.0  # [kg]
    drag: float = 0.2  # [N s/m]
    state_dim: int = 4
    control_dim: int = 2
    # Optional: an energy that u = d = 0 leaves as it is or, if it dissipates, lets fall.
    dissipates = True

    def energy(self, state: Sequence[Any], functions: Any) -> Any:
        """Return the energy [J]."""
        _, _, vx, vy = state
        return 0.5 * self.mass * (vx**2 + vy**2)

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt: + - * /, integer powers, functions.sin, cos, tan, exp, sqrt; no if."""
        _, _, vx, vy = state
        fx, fy = control
        return vx, vy, (fx - self.drag * vx) / self.mass, (fy - self.drag * vy) / self.mass


@dataclass(frozen=True)
class ${title}Task(Task):
    """Come within 0.3 m of the goal by the end of 6 s."""

    system: ${title}System = field(default_factory=${title}System)
    control_period: float = 0.1  # each control is held so long [s]
    time_limit: float = 6.0  # of an episode and of a plan [s]

    name, title = "$name", "$title"
    state_names = ("x [m]", "y [m]", "vx [m/s]", "vy [m/s]")
    control_names = ("fx [N]", "fy [N]")
    control_low, control_high = (-4.0, -4.0), (4.0, 4.0)  # the environment clips
    control_scale = (4.0, 4.0)  # of the action 1
    rates = (2, 3)  # the states that --channels rates disturbs
    goal_radius = 0.3  # success is to come so near
    position = (0, 1)  # where the body is drawn; leave it out if it has no place in a plane
$discs    # The law along a plan: weights of the squares of states and of controls.
    feedback = Feedback((4.0, 4.0, 1.0, 1.0), (0.5, 0.5))
    # What commands take: which policies, and the bound of the disturbance [state / s].
    defaults = Defaults(("tube-mpc", "lqr"), bounds=($bound,), bound=$bound)
'''
_FREE = '''
    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start and goal of an episode."""
        ends = np.zeros((2, 4))
        ends[:, :2] = rng.uniform(-3.0, 3.0, (2, 2))
        return Scenario(ends[0], ends[1])
'''
_AMONG = '''
    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start, goal and two discs (x, y, radius) between them, clear of both."""
        start, goal = np.zeros(4), np.zeros(4)
        start[1], goal[:2] = rng.uniform(-1.0, 1.0), (5.0, rng.uniform(-1.0, 1.0))
        discs = np.column_stack([(1.7, 3.3), rng.uniform(-1.0, 1.0, 2), (0.4, 0.4)])
        return Scenario(start, goal, discs)
'''
_DISCS = """    # Discs that the body must not touch: its radius, how many, room that plans keep.
    body_radius, most_discs, margin = 0.2, 2, 0.25
"""


def new(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.py", help="What to write; its name is the task's.")
    ],
    discs: Annotated[bool, typer.Option("--discs", help="With discs that are in the way.")] = False,
) -> None:
    """Write the commented file of a system of your own, which runs at once.

    It is a mass in the plane until you put your equation there; never over what exists.
    """
    from lagros_envs.files import write_atomic

    try:
        text = written(file, discs)
        if file.exists() or file.is_symlink():
            raise ValueError(f"{file} exists, and is left as it is; name another")
        if not file.parent.is_dir():
            raise ValueError(f"{file}: there is no folder {file.parent}")
    except ValueError as error:
        fail(error)
    try:
        write_atomic(file, text)
    except OSError as error:
        fail(error, status=1)
    shown = file if file.is_absolute() or len(file.parts) > 1 else f"./{file}"
    typer.echo(f"wrote {file}; next: lagros check {shown}, then lagros bench {shown}")


def written(file: Path, discs: bool = False) -> str:
    """Return the text of a new file.

    Args:
        file: Its path; the stem is the name of the task.
        discs: Whether discs are in the way.

    Raises:
        ValueError: The name is none of a task, or is taken.
    """
    from lagros_envs.checks import shown
    from lagros_envs.tasks import SHIPPED

    name = file.stem
    if file.suffix != ".py":
        raise ValueError(f"file: {file} must end in .py")
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ValueError(
            f"file: {shown(name)} cannot be the name of a task: begin with a small letter, and go "
            "on with small letters, digits, _ and -, as in my_boat.py"
        )
    title = "".join(part[:1].upper() + part[1:] for part in re.split("[-_]+", name))
    taken = {one.title.lower() for one in SHIPPED.values()} | set(SHIPPED)
    if {name, title.lower()} & taken:
        raise ValueError(f"{shown(name)} is a task of this package; choose another name")
    parts = Template(_HEAD + (_AMONG if discs else _FREE))
    place = file.as_posix() if len(file.parts) > 1 else f"./{file.name}"
    return parts.substitute(
        title=title,
        name=name,
        file=place,
        among=" among discs" if discs else "",
        discs=_DISCS if discs else "",
        bound="0.2",
    )
