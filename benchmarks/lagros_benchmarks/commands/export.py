"""`lagros export`: a policy as an ONNX model or one C99 file.

Only the standard library, typer and `terminal` are imported here; the command imports the rest.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import fail

if TYPE_CHECKING:
    from lagros_policies.export.c99 import Tanh
    from lagros_policies.export.check import Agreement
    from lagros_policies.export.source import Source

FORMATS = ("c", "onnx")
# Largest difference from NumPy, in units of the largest force, with which a file is written: room
# for float32 summed in another order, and for no mistake.
TOLERANCE = 1e-5


def export(
    policy: Annotated[
        str,
        typer.Argument(
            help="lagros-cartpole, learned-cartpole, lagros-spacecraft or learned-spacecraft."
        ),
    ],
    format_: Annotated[
        str,
        typer.Option("--format", metavar="FORMAT", help="c (one C99 file) or onnx."),
    ] = "c",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", dir_okay=False, help="Where to; lagros_cartpole.c or .onnx, and so on."
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", dir_okay=False, help="Weights of your own; the shipped ones if not."
        ),
    ] = None,
    tanh: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="In C, of the cart-pole: rational (a quotient of polynomials, 4e-7 off) or libm "
            "(much slower); rational if not given.",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="Of the spacecraft: the radii of its bodies; paper if not given."),
    ] = None,
    agents: Annotated[
        int | None,
        typer.Option(help="Of the spacecraft: slots of the observation in ONNX; as the preset."),
    ] = None,
) -> None:
    """Write a policy's network as one C file or ONNX model: observation in, newtons out."""
    from lagros_envs.checks import shown
    from lagros_envs.files import write_atomic
    from lagros_policies.export.c99 import TANHS
    from lagros_policies.export.source import CARTPOLE_NAMES, SPACECRAFT_NAMES, load_source

    if format_ not in FORMATS:
        fail(f"--format: {shown(format_)} must be one of {', '.join(FORMATS)}")
    if tanh is not None and tanh not in TANHS:
        fail(f"--tanh: {shown(tanh)} must be one of {', '.join(TANHS)}")
    if format_ == "onnx" and tanh is not None:
        fail("--tanh is for --format c; leave it out for onnx")
    if policy in CARTPOLE_NAMES and (preset is not None or agents is not None):
        fail("--preset and --agents are for the spacecraft; leave them out for the cart-pole")
    if policy in SPACECRAFT_NAMES and tanh is not None:
        fail("--tanh is for the cart-pole; the spacecraft's network has no tanh: leave it out")
    path = out or Path(f"{policy.replace('-', '_')}.{format_}")
    try:
        source = load_source(policy, weights, preset or "paper", agents)
        check_outputs({"--out": path}, {"--weights": weights})
    except (ValueError, OSError) as error:
        fail(error)
    try:
        data, found, cost = _written(source, format_, cast("Tanh", tanh or TANHS[0]))
    except RuntimeError as error:
        fail(error, status=1)
    if isinstance(found, str):
        line = f"not compared with NumPy: {found}"
    elif found.relative <= TOLERANCE:
        line = f"differs from NumPy, over 1000 observations, by at most {found}"
    else:
        # A NaN lands here too.
        fail(f"not written: the export and NumPy differ by {found}", status=1)
    delivery = Delivery()
    delivery.write(
        path,
        lambda place: write_atomic(place, data),
        (lambda: data) if isinstance(data, str) else None,
    )
    typer.echo(f"weights {source.file}, SHA-256 {source.digest}")
    for told in (line, *cost):
        typer.echo(told)
    delivery.tell(f"{len(data) / 1e3:.0f} kB")


def _written(
    source: Source, format_: str, tanh: Tanh
) -> tuple[str | bytes, Agreement | str, list[str]]:
    """Return the file's content, how it compares with NumPy, or why not, and what it costs."""
    from lagros_policies.export import check
    from lagros_policies.export.cost import PLAIN, c_time, onnx_time
    from lagros_policies.export.file import c_file, onnx_file

    if format_ == "c":
        text = c_file(source, tanh)
        if check.compiler() is None:
            return text, "no C compiler (gcc, cc) is on the path", []
        found = check.check_c(text, source)
        where = f"here, {Path(check.compiler() or 'cc').name} {' '.join(PLAIN)}"
        return text, found, [_time(*c_time(text, source), where), *_bytes(text)]
    model = onnx_file(source)
    if not check.has_onnxruntime():
        return model, f"ONNX Runtime is not installed ({check.INSTALL})", []
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
