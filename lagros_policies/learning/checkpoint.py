"""The progress of a training run with Adam as safetensors, so that a checkpoint holds no code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import shown
from lagros_policies.learning.networks import read_safetensors, write_safetensors

if TYPE_CHECKING:
    import torch


def save_progress(
    path: Path,
    parameters: Sequence[torch.nn.Parameter],
    optimiser: torch.optim.Adam,
    fingerprint: str,
    epoch: int,
) -> None:
    """Write parameters and Adam's moments, whole or not at all.

    Args:
        path: The checkpoint.
        parameters: In an order that `load_progress` is given again.
        optimiser: Of these parameters, after at least one step.
        fingerprint: What the run depends on.
        epoch: Epochs done.
    """
    tensors: dict[str, Any] = {}
    for index, parameter in enumerate(parameters):
        slots = optimiser.state[parameter]
        tensors[f"{index}.value"] = parameter.detach().numpy()
        tensors[f"{index}.mean"] = slots["exp_avg"].numpy()
        tensors[f"{index}.square"] = slots["exp_avg_sq"].numpy()
        tensors[f"{index}.step"] = np.array([float(slots["step"])], np.float32)
    write_safetensors(path, tensors, {"fingerprint": fingerprint, "epoch": str(epoch)})


def load_progress(
    path: Path,
    parameters: Sequence[torch.nn.Parameter],
    optimiser: torch.optim.Adam,
    fingerprint: str,
) -> int:
    """Take up a run where its checkpoint left it; without a file nothing changes.

    Args:
        path: The checkpoint.
        parameters: Overwritten.
        optimiser: Of these parameters; its state is overwritten.
        fingerprint: What the run depends on.

    Returns:
        Epochs done.

    Raises:
        ValueError: The checkpoint is damaged or has another fingerprint.
    """
    import torch

    if not path.exists():
        return 0
    tensors, metadata = _read(path, parameters)
    if metadata.get("fingerprint") != fingerprint:
        raise ValueError(f"{path} belongs to other settings or data; remove it to start anew")
    epoch = metadata.get("epoch", "")
    if not epoch.isdecimal():
        raise ValueError(f"{path} is damaged: epoch={shown(epoch)}; remove it to start anew")
    with torch.no_grad():
        for index, parameter in enumerate(parameters):
            parameter.copy_(torch.from_numpy(tensors[f"{index}.value"]))
            optimiser.state[parameter] = {
                "step": torch.tensor(float(tensors[f"{index}.step"][0])),
                "exp_avg": torch.from_numpy(tensors[f"{index}.mean"].copy()),
                "exp_avg_sq": torch.from_numpy(tensors[f"{index}.square"].copy()),
            }
    return int(epoch)


def load_values(path: Path, parameters: Sequence[torch.nn.Parameter]) -> None:
    """Take over what a run that ended has learned, and nothing else of it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The checkpoint is damaged, or of another network.
    """
    import torch

    tensors, _ = _read(path, parameters)
    with torch.no_grad():
        for index, parameter in enumerate(parameters):
            parameter.copy_(torch.from_numpy(tensors[f"{index}.value"]))


def _read(
    path: Path, parameters: Sequence[torch.nn.Parameter]
) -> tuple[dict[str, NDArray[np.float32]], dict[str, str]]:
    tensors, metadata = read_safetensors(path)
    if _shapes(parameters) != {name: tensor.shape for name, tensor in tensors.items()}:
        raise ValueError(f"{path} holds another network; remove it to start anew")
    return tensors, metadata


def _shapes(parameters: Sequence[torch.nn.Parameter]) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for index, parameter in enumerate(parameters):
        for part in ("value", "mean", "square"):
            shapes[f"{index}.{part}"] = tuple(parameter.shape)
        shapes[f"{index}.step"] = (1,)
    return shapes
