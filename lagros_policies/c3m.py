"""C3M: a contraction metric and a tracking controller that were learned together, as networks.

Sun, Jha & Fan, "Learning certified control using contraction metric", CoRL 2020
(https://arxiv.org/abs/2011.12569). `learning.c3m` trains them; here they run in NumPy.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.task import Task
from lagros_policies.learning.networks import (
    Layers,
    Mlp,
    layers_of,
    read_safetensors,
    tensors_of,
    write_safetensors,
)
from lagros_policies.room import found_file, task_of
from lagros_policies.trained_for import KEYS, check_weights
from lagros_policies.tube_mpc import TubeMpcPolicy

_FORMAT = "lagros-c3m-1"
_SEEN, _FREE = "seen", "free"
PARTS = ("inner", "outer", "base", "rest")
_SCALES = ("centre", "scale", "control_scale")


@dataclass(frozen=True)
class Scaled:
    """The coordinates in which the networks work: (x - centre) / scale, controls likewise.

    Attributes:
        centre: Middle of each coordinate of x_d, shape (n,).
        scale: Unit of each coordinate and of its error, shape (n,), positive.
        control_scale: Unit of each control, shape (m,), positive.
        seen: Which coordinates the controller sees: those on which the slopes of the motion depend.
        free: Which coordinates no control moves; the rows and columns of W that belong to them
            depend on seen ones of them alone.
    """

    centre: NDArray[Any]
    scale: NDArray[Any]
    control_scale: NDArray[Any]
    seen: tuple[int, ...]
    free: tuple[int, ...]

    @property
    def moved(self) -> tuple[int, ...]:
        """The coordinates that controls move."""
        return tuple(index for index in range(len(self.scale)) if index not in self.free)

    @property
    def seen_free(self) -> tuple[int, ...]:
        """What the part of W that belongs to `free` sees."""
        return tuple(index for index in self.seen if index in self.free)


@dataclass(frozen=True)
class ContractionNetworks:
    """W(x) and u(x, x_d, u_d) of C3M, as plain arrays.

    With z, z_d and e the scaled states and their difference,

        u = u_d + S_u w_2(z, z_d) tanh(w_1(z, z_d) e),   W = S (C'C + w_lb I) S,

    the entries of w_1 (c, n), w_2 (m, c) and C being networks of one hidden layer. C is block upper
    triangular: the block of the coordinates that no control moves sees no others.

    Attributes:
        scaled: The coordinates.
        inner: w_1 by rows.
        outer: w_2 by rows.
        base: The block of C of `scaled.free`, by rows.
        rest: The columns of C of `scaled.moved`, by rows; None where there are none.
        least: w_lb.
        metadata: What `trained_for.weights_record` says of it; stored beside the arrays.
    """

    scaled: Scaled
    inner: Mlp
    outer: Mlp
    base: Mlp
    rest: Mlp | None
    least: float
    metadata: Mapping[str, str] = field(default_factory=dict)

    name = "c3m"

    def __call__(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u, shape (s, m), at x (s, n), x_d (s, n) and u_d (s, m)."""
        scaled = self.scaled
        error = ((state - nominal) / scaled.scale).astype(np.float32)
        shown = np.concatenate([self._seen(state), self._seen(nominal)], axis=-1)
        n, m = len(scaled.scale), len(scaled.control_scale)
        first = self.inner(shown).reshape(len(error), -1, n)
        second = self.outer(shown).reshape(len(error), m, -1)
        inner = np.tanh(np.einsum("scn,sn->sc", first, error))
        control: FloatArray = nominal_control + scaled.control_scale * np.einsum(
            "smc,sc->sm", second, inner
        )
        return control

    def dual_metric(self, state: FloatArray) -> FloatArray:
        """Return W, shape (s, n, n), at x (s, n)."""
        scaled = self.scaled
        n, count = len(scaled.scale), len(scaled.free)
        factor = np.zeros((len(state), n, n))
        free, moved = list(scaled.free), list(scaled.moved)
        base = self.base(self._seen(state, scaled.seen_free))
        factor[:, :count, free] = base.reshape(-1, count, count)
        if self.rest is not None:
            factor[:, :, moved] = self.rest(self._seen(state)).reshape(-1, n, n - count)
        inside = np.swapaxes(factor, -1, -2) @ factor + self.least * np.eye(n)
        dual: FloatArray = scaled.scale[:, None] * inside * scaled.scale
        return dual

    def _seen(self, state: FloatArray, which: tuple[int, ...] | None = None) -> Float32Array:
        scaled = self.scaled
        index = list(scaled.seen if which is None else which)
        if not index:  # networks of nothing are constants
            return np.zeros((len(state), 1), np.float32)
        moved = (state[:, index] - scaled.centre[index]) / scaled.scale[index]
        shown: Float32Array = moved.astype(np.float32)
        return shown

    def save(self, path: Path | str) -> None:
        """Write the arrays as safetensors, atomically."""
        layers = {
            part: list(zip(network.weights, network.biases, strict=True))
            for part, network in self._networks.items()
        }
        tensors = tensors_of(layers) | {
            name: np.asarray(getattr(self.scaled, name), np.float32) for name in _SCALES
        }
        metadata = {
            **self.metadata,
            "format": _FORMAT,
            "activation": "tanh",
            "least": repr(self.least),
            _SEEN: json.dumps(self.scaled.seen),
            _FREE: json.dumps(self.scaled.free),
        }
        write_safetensors(path, tensors, metadata)

    @property
    def _networks(self) -> dict[str, Mlp]:
        found = {part: getattr(self, part) for part in PARTS}
        return {part: network for part, network in found.items() if network is not None}

    @classmethod
    def load(cls, path: Path | str) -> ContractionNetworks:
        """Read the networks; nothing in the file is executed.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or holds no such networks.
        """
        tensors, metadata = read_safetensors(path)
        if metadata.get("format") != _FORMAT or metadata.get("activation") != "tanh":
            raise ValueError(f"{path} holds no networks of c3m")
        try:
            centre, scale, control = (tensors.pop(name).astype(np.float64) for name in _SCALES)
            seen, free = (_indices(metadata[name], len(scale)) for name in (_SEEN, _FREE))
            parts = [part for part in PARTS if part != "rest" or "rest0.weight" in tensors]
            found = dict(zip(parts, layers_of(path, tensors, parts), strict=True))
            networks = {part: mlp_of(layers) for part, layers in found.items()}
            kept = {name: metadata[name] for name in KEYS if name in metadata}
            made = cls(
                Scaled(centre, scale, control, seen, free),
                networks["inner"],
                networks["outer"],
                networks["base"],
                networks.get("rest"),
                float(metadata["least"]),
                kept,
            )
            made.check()
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from error
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        return made

    def check(self) -> None:
        """Try the networks once.

        Raises:
            ValueError: Their shapes do not fit together.
        """
        n, m = len(self.scaled.scale), len(self.scaled.control_scale)
        state, control = np.zeros((1, n)), np.zeros((1, m))
        if self(state, state, control).shape != (1, m) or not self.least > 0.0:
            raise ValueError("the networks do not fit together")
        self.dual_metric(state)


def mlp_of(layers: Layers) -> Mlp:
    """Return a network of its layers."""
    return Mlp([weight for weight, _ in layers], [bias for _, bias in layers])


def _indices(text: str, count: int) -> tuple[int, ...]:
    found = json.loads(text)
    if not isinstance(found, list) or not set(found) <= set(range(count)):
        raise ValueError(f"{text} must list coordinates below {count}")
    return tuple(found)


class C3mPolicy(TubeMpcPolicy):
    """The controller of C3M along the plan of `TubeMpcPolicy`.

    Args:
        settings: The task; None for the paper's.
        weights: A file written by `ContractionNetworks.save`, or the networks; the task's own if
            left out.
        allow_other_settings: Fly settings too for which the networks were not trained.
        deadline: As of `TubeMpcPolicy`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, of another task, or of a training for other settings.

    Attributes:
        law: The networks.
    """

    recorded_as = "c3m"

    def __init__(
        self,
        settings: Task | None = None,
        weights: Path | str | ContractionNetworks | None = None,
        allow_other_settings: bool = False,
        deadline: float | None = None,
    ) -> None:
        task = task_of(settings)
        if weights is None:
            weights = found_file(task, "c3m.safetensors", "--algo c3m")
        if isinstance(weights, ContractionNetworks):
            self.law, what = weights, "the networks"
        else:
            self.law, what = ContractionNetworks.load(weights), str(weights)
        sizes = len(self.law.scaled.scale), len(self.law.scaled.control_scale)
        if sizes != (task.system.state_dim, task.system.control_dim):
            raise ValueError(
                f"{what} are of {sizes[0]} states and {sizes[1]} controls; {task.name} has "
                f"{task.system.state_dim} and {task.system.control_dim}"
            )
        check_weights(task, self.law.metadata, what, self, False, allow_other_settings)
        super().__init__(task, deadline=deadline, law=self.law)
