"""`lagros export`: a cart-pole policy as an ONNX model or one C99 file.

Only the standard library and typer are imported here; the command imports the rest.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

if TYPE_CHECKING:
    from lagros_policies.export.c99 import Tanh
    from lagros_policies.export.check import Agreement
    from lagros_policies.export.source import NetworkSource

FORMATS = ("c", "onnx")
# Largest difference from NumPy, in units of the largest force, with which a file is written: room
# for float32 summed in another order, and for no mistake.
TOLERANCE = 1e-5


def export(
    policy: Annotated[str, typer.Argument(help="lagros-cartpole or learned-cartpole.")],
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
        str,
        typer.Option(
            metavar="KIND",
            help="In C: libm, or rational (a quotient of polynomials, 4e-7 off, much faster).",
        ),
    ] = "libm",
) -> None:
    """Write u_L(x, o, t) as a file without Python: features, mirror and network, in newtons."""
    from lagros_benchmarks.cli import fail
    from lagros_envs.files import write_atomic
    from lagros_policies.export.c99 import TANHS
    from lagros_policies.export.source import load_source

    if format_ not in FORMATS:
        fail(f"--format: {format_!r} must be one of {', '.join(FORMATS)}")
    if tanh not in TANHS:
        fail(f"--tanh: {tanh!r} must be one of {', '.join(TANHS)}")
    if format_ == "onnx" and tanh != "libm":
        fail("--tanh is for --format c; leave it out for onnx")
    try:
        source = load_source(policy, weights)
    except (ValueError, OSError) as error:
        fail(error)
    try:
        data, found = _written(source, format_, cast("Tanh", tanh))
    except RuntimeError as error:
        fail(error, status=1)
    if isinstance(found, str):
        line = f"not compared with NumPy: {found}"
    elif found.relative <= TOLERANCE:
        line = f"differs from NumPy, over 1000 observations, by at most {found}"
    else:
        # A NaN lands here too.
        fail(f"not written: the export and NumPy differ by {found}", status=1)
    path = out or Path(f"{policy.replace('-', '_')}.{format_}")
    try:
        write_atomic(path, data)
    except OSError as error:
        fail(f"cannot write {path}: {error}")
    typer.echo(f"weights {source.file}, SHA-256 {source.digest}")
    typer.echo(line)
    typer.echo(f"wrote {path} ({path.stat().st_size / 1e3:.0f} kB)")


def _written(
    source: NetworkSource, format_: str, tanh: Tanh
) -> tuple[str | bytes, Agreement | str]:
    """Return the file's content and how it compares with NumPy, or why it was not compared."""
    from lagros_policies.export import check
    from lagros_policies.export.c99 import c_source
    from lagros_policies.export.onnx import policy_model

    if format_ == "c":
        text = c_source(source, tanh)
        if check.compiler() is None:
            return text, "no C compiler (gcc, cc) is on the path"
        return text, check.check_c(text, source)
    model = policy_model(source)
    if not check.has_onnxruntime():
        return model, "ONNX Runtime is not installed (pip install onnxruntime)"
    return model, check.check_onnx(model, source)
