"""Which extra of the distribution brings what is missing, so that a message can name it.

Only the standard library is imported here: it must work where nothing else is installed.
"""

from __future__ import annotations

from importlib.util import find_spec

# The packages of each extra that the command line may ask for, by the name of their import. Of two
# extras that hold one package, the first is named: the command line is there already.
MODULES = {
    "policies": ("clarabel", "piqp", "safetensors", "scipy"),
    "bench": ("PIL", "joblib", "matplotlib", "rich", "typer"),
    "train": ("cvxpy", "joblib", "osqp", "torch"),
    "rl": ("stable_baselines3", "tensorboard"),
    "render": ("pygame",),
    "video": ("imageio_ffmpeg",),
    "data": ("PIL", "minari", "pyarrow"),
    "onnx": ("onnx", "onnxruntime"),
    "attack": ("cmaes",),
    "ray": ("ray",),
    "dask": ("distributed", "joblib"),
    "fast": ("numba",),
    "pandas": ("pandas",),
}


def check_extra(what: str, extra: str, *modules: str) -> None:
    """Check, before any work, that the modules of an extra are installed, or those that are named.

    Raises:
        ImportError: One is missing; the message says `what` needs it.
    """
    missing = [module for module in modules or MODULES[extra] if find_spec(module) is None]
    if missing:
        raise ImportError(f"{what} needs {', '.join(missing)}: pip install 'lagros[{extra}]'")


def install_hint(error: BaseException) -> str:
    """Return how to install what an exception, or one that caused it, did not find; "" if unknown.

    It is a clause that begins with a semicolon, for the end of a message.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ModuleNotFoundError):
            package = (cause.name or "").partition(".")[0]
            for extra, packages in MODULES.items():
                if package in packages:
                    return f"; pip install 'lagros[{extra}]' brings {package}"
        cause = cause.__cause__
    return ""
