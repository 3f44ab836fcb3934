"""Which extra of the distribution brings what is missing, so that a message can name it.

Only the standard library is imported here: it must work where nothing else is installed.
"""

from __future__ import annotations

# The packages of each extra that the command line may ask for, by the name of their import. Of two
# extras that hold one package, the first is named: the command line is there already.
MODULES = {
    "policies": ("clarabel", "piqp", "safetensors", "scipy"),
    "bench": ("PIL", "joblib", "matplotlib", "rich", "typer"),
    "train": ("cvxpy", "joblib", "torch"),
    "rl": ("stable_baselines3", "tensorboard"),
    "render": ("pygame",),
    "video": ("imageio_ffmpeg",),
    "data": ("PIL", "minari", "pyarrow"),
    "onnx": ("onnxruntime",),
    "attack": ("cmaes",),
    "ray": ("ray",),
    "dask": ("distributed", "joblib"),
    "fast": ("numba",),
}


def install_hint(error: BaseException) -> str:
    """Return how to install what an exception, or one that caused it, did not find; "" if unknown.

    Args:
        error: Any exception.

    Returns:
        A clause that begins with a semicolon, for the end of a message.
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
