"""What all figures share: styles of the policies, an empty figure, and how it is written.

The colours are Okabe and Ito's, which colour-blind readers can tell apart; line styles, markers and
direct labels tell the policies apart in greyscale.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, overload

import numpy as np

from lagros_benchmarks.run.files import write_atomic
from lagros_envs.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FORMATS = (".png", ".pdf", ".svg")
BLACK = "#000000"  # of the tubes; no policy has it
LONGEST_LABEL = 24  # of a policy in a figure
_DOTS_PER_INCH = 150
_LONG_RANGE = 1e3  # of a logarithmic ordinate, from which only powers of ten are labelled


class Style(NamedTuple):
    """How a policy is drawn: colour, line style and marker of Matplotlib."""

    colour: str
    line: Any
    marker: str


_STYLES = {
    "learned": Style("#E69F00", (0, (5, 1.5, 1, 1.5)), "s"),
    "learned-mpc": Style("#A6761D", (0, (5, 1.5)), "p"),
    "tube-mpc": Style("#0072B2", (0, (5, 2)), "o"),
    "lagros": Style("#D55E00", "solid", "D"),
    "centralized": Style("#333333", (0, (1, 1)), "^"),
    "lqr": Style("#009E73", (0, (1, 1.2)), "^"),
    "lqr-plan": Style("#117733", (0, (2, 1.5, 6, 1.5)), "8"),
    "sd-lqr": Style("#44BB99", (0, (5, 1, 2, 1)), "<"),
    "mpc": Style("#4477AA", (0, (2, 2)), "h"),
    "c3m": Style("#AA3377", (0, (7, 2, 2, 2)), "H"),
    "ppo": Style("#CC79A7", (0, (8, 2, 1, 2, 1, 2)), "v"),
    "sac": Style("#56B4E9", (0, (6, 1)), "P"),
    "td3": Style("#B8860B", (0, (3, 1, 1, 1)), "X"),
    "residual": Style("#882255", (0, (4, 4)), "*"),
    "random": Style("#999999", (0, (2, 3)), "x"),
}
# Policies of the user's own.
_OTHERS = (
    Style("#6B4423", (0, (9, 3)), ">"),
    Style("#332288", (0, (1, 3)), r"$\spadesuit$"),
    Style("#999933", (0, (7, 1, 1, 1)), r"$\clubsuit$"),
    Style("#44AA99", (0, (3, 3)), r"$\heartsuit$"),
    Style("#AA4499", (0, (9, 2, 3, 2)), "d"),
)


def styles(policies: Sequence[str]) -> dict[str, Style]:
    """Return a style for each policy; a known name looks the same in every figure."""
    strangers = [name for name in policies if name not in _STYLES]
    found = {name: _OTHERS[index % len(_OTHERS)] for index, name in enumerate(strangers)}
    return {name: _STYLES[name] if name in _STYLES else found[name] for name in policies}


# What a figure was drawn into: its file, or itself where it has none.
Drawn: TypeAlias = "Path | Figure"


@overload
def check_figure_path(path: str | Path) -> Path: ...
@overload
def check_figure_path(path: str | Path | None) -> Path | None: ...
def check_figure_path(path: str | Path | None) -> Path | None:
    """Return the path of a figure; None for one that goes into no file.

    Raises:
        ValueError: Its suffix names no format that can be drawn.
        ModuleNotFoundError: Matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ModuleNotFoundError("a figure needs Matplotlib", name="matplotlib")
    if path is None:
        return None
    if Path(path).suffix.lower() not in FORMATS:
        raise ValueError(f"figure {str(path)!r} must end in {', '.join(FORMATS)}")
    return Path(path)


def canvas(
    width: float,
    height: float,
    lines: int = 1,
    columns: int = 1,
    share: Literal["all", "row"] = "all",
    abscissa: bool = True,
) -> tuple[Figure, list[Axes]]:
    """Return an empty figure of a size [inch] and its panels, line by line.

    They share their ordinate as Matplotlib's `sharey` says, and, if asked for, their abscissa.
    """
    # No pyplot: it keeps global state and picks a window system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=abscissa, sharey=share)
    panels: list[Axes] = list(grid.flat)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
    return figure, panels


def log_ordinate(axes: Axes) -> None:
    """Make an ordinate logarithmic, with labels that are plain numbers: 0.5, 1, 2.

    Matplotlib's own label every mark of a short range, as 6×10⁰.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log", nonpositive="mask")
    low, high = axes.get_ylim()
    marks = (1.0, 2.0, 5.0) if high < _LONG_RANGE * low else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=marks))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(LogLocator(subs="all"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def curve(values: Any) -> FloatArray:
    """Return numbers as an array, null as nan."""
    # A row that went through JSON has null where a number was not finite.
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def legend(figure: Figure, axes: Axes) -> None:
    """Write the names of the lines of one panel above all of them."""
    handles, names = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside upper left",
        ncols=min(len(names), 4),
        frameon=False,
        handlelength=3.5,
    )


def caption(figure: Figure, text: str) -> None:
    """Write a few lines below a figure."""
    figure.supxlabel(text, fontsize=8, color="#444444", x=0.01, ha="left")


@overload
def save(figure: Figure, path: Path) -> Path: ...
@overload
def save(figure: Figure, path: Path | None) -> Drawn: ...
def save(figure: Figure, path: Path | None) -> Drawn:
    """Write a figure in the format that its path names, and return the path; itself for None."""
    if path is None:
        return figure
    stream = io.BytesIO()
    figure.savefig(stream, format=path.suffix.lower()[1:])
    return write_atomic(path, stream.getvalue())
