"""`lagros export`: a policy as an ONNX model or one C99 file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import fail, file_option, task_in_preset

if TYPE_CHECKING:
    from lagros_policies.export.c99 import Tanh
    from lagros_policies.export.check import Agreement
    from lagros_policies.export.source import Source

FORMATS = ("c", "onnx")
# Largest difference from NumPy, in units of the largest control, with which a file is written: room
# for float32 summed in another order, and for no mistake.
TOLERANCE = 1e-5


def export(
    policy: Annotated[
        str, typer.Argument(help="lagros or learned, and TASK; or both in one, POLICY-TASK.")
    ],
    task: Annotated[
        str | None, typer.Argument(help="A name, module:attribute or ./file.py, if not in POLICY.")
    ] = None,
    format_: Annotated[
        str, typer.Option("--format", metavar="FORMAT", help="c (one C99 file) or onnx.")
    ] = "c",
    out: Annotated[Path | None, file_option("Where to; POLICY_TASK.c or .onnx.")] = None,
    weights: Annotated[
        Path | None, file_option("Weights of your own; those of the task if not.")
    ] = None,
    tanh: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="In C, of a network with tanh: rational (a quotient of polynomials, 4e-7 off) or "
            "libm (much slower); rational if not given.",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Of many agents: the radii of their bodies; of one body, its form. The "
            "first of `lagros bench` if not given."
        ),
    ] = None,
    agents: Annotated[
        int | None,
        typer.Option(help="Of many agents: slots of the observation in ONNX; as the preset."),
    ] = None,
) -> None:
    """Write a policy's network as one C file or ONNX model: observation in, controls out."""
    from lagros_envs.checks import shown
    from lagros_envs.files import write_atomic
    from lagros_envs.task import Task
    from lagros_policies.export.c99 import TANHS
    from lagros_policies.export.source import load_source, parted

    if format_ not in FORMATS:
        fail(f"--format: {shown(format_)} must be one of {', '.join(FORMATS)}")
    if tanh is not None and tanh not in TANHS:
        fail(f"--tanh: {shown(tanh)} must be one of {', '.join(TANHS)}")
    if format_ == "onnx" and tanh is not None:
        fail("--tanh is for --format c; leave it out for onnx")
    try:
        if task is not None:
            task, preset = task_in_preset(task, preset)
        told = {"preset": preset, "num_agents": agents}
        given = {name: value for name, value in told.items() if value is not None}
        full = policy if task is None else f"{policy}-{task}"
        found = parted(full)[1]
        if given and isinstance(found, Task):
            fail(f"{found.name} is one body: --preset and --agents do not fit; leave them out")
        source = load_source(full, weights, **given)
        path = out or Path(f"{source.identifier}.{format_}")
        check_outputs({"--out": path}, {"--weights": weights})
    except (ValueError, OSError) as error:
        fail(error)
    if tanh is not None and not source.program.tanh:
        fail(f"the network of {source.name} has no tanh: leave --tanh out")
    try:
        data, compared, cost = _written(source, format_, cast("Tanh", tanh or TANHS[0]))
    except (RuntimeError, ImportError) as error:
        fail(error, status=1)
    if isinstance(compared, str):
        line = f"not compared with NumPy: {compared}"
    elif compared.relative <= TOLERANCE:
        line = f"differs from NumPy, over 1000 observations, by at most {compared}"
    else:
        # A NaN lands here too.
        fail(f"not written: the export and NumPy differ by {compared}", status=1)
    delivery = Delivery()
    delivery.write(
        path,
        lambda place: write_atomic(place, data),
        (lambda: data) if isinstance(data, str) else None,
    )
    typer.echo(f"weights {source.file}, SHA-256 {source.digest}")
    for text in (line, *cost):
        typer.echo(text)
    delivery.tell(f"{len(data) / 1e3:.0f} kB")


def _written(
    source: Source, format_: str, tanh: Tanh
) -> tuple[str | bytes, Agreement | str, list[str]]:
    """Return the file's content, how it compares with NumPy, or why not, and what it costs."""
    from lagros_policies.export import check
    from lagros_policies.export.c99 import c_file
    from lagros_policies.export.cost import PLAIN, c_time, onnx_time
    from lagros_policies.export.onnx import INSTALL, onnx_file

    if format_ == "c":
        text = c_file(source, tanh)
        if check.compiler() is None:
            return text, "no C compiler (gcc, cc) is on the path", []
        found = check.check_c(text, source)
        where = f"here, {Path(check.compiler() or 'cc').name} {' '.join(PLAIN)}"
        return text, found, [_time(*c_time(text, source), where), *_bytes(text)]
    model = onnx_file(source)
    if not check.has_onnxruntime():
        return model, f"ONNX Runtime is not installed ({INSTALL})", []
    found = check.check_onnx(model, source)
    return model, found, [_time(*onnx_time(model, source), "here, ONNX Runtime, one thread")]


def _time(ours: float, numpys: float, where: str) -> str:
    return f"one call {1e9 * ours:.0f} ns, NumPy predict {1e9 * numpys:.0f} ns ({where})"


def _bytes(text: str) -> list[str]:
    """Return the line of the bytes; none where the tools that count them are others."""
    from lagros_policies.export.cost import footprint

    try:
        return [str(footprint(text))]
    except (FileNotFoundError, RuntimeError):
        return []
