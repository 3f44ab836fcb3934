"""The loop of all fits: which samples it takes when, how its step falls, what it reports."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lagros_policies.learning import train, train_deep_set
from lagros_policies.learning.fitting import Fit, one_thread


@dataclass(frozen=True)
class Settings:
    epochs: int = 4
    learning_rate: float = 0.5
    checkpoint_every: int = 3
    seed: int = 7


class Recorder(Fit[Settings]):
    """Fits one number to nothing; the loss of sample i is i, and the step is noted."""

    def __init__(self, checkpoint, settings=Settings(), count=10):
        self.taken, self.steps, self.saved = [], [], []
        super().__init__(settings, checkpoint, [torch.nn.Parameter(torch.zeros(1))], count, "data")

    def batches(self, order):
        self.taken.append(order)
        return np.array_split(order, 4)  # of 3, 3, 2 and 2 samples

    def loss(self, batch):
        self.steps.append(self.optimiser.param_groups[0]["lr"])
        return (0.0 * self.parameters[0] + float(np.mean(batch))).sum()

    def save(self):
        self.saved.append(self.epoch)
        super().save()


def test_every_epoch_takes_every_sample_once_in_an_order_of_its_own(tmp_path):
    run = Recorder(tmp_path / "run")
    run.finish()
    assert len(run.taken) == 4
    assert all(sorted(order) == list(range(10)) for order in run.taken)
    assert len({tuple(order) for order in run.taken}) == 4
    again = Recorder(tmp_path / "again")
    again.finish()
    np.testing.assert_array_equal(again.taken, run.taken)
    other = Recorder(tmp_path / "other", Settings(seed=8))
    other.finish()
    assert not np.array_equal(other.taken, run.taken)


def test_the_step_falls_along_half_a_cosine_to_a_hundredth(tmp_path):
    run = Recorder(tmp_path / "run")
    run.finish()
    assert run.steps[0] == 0.5
    assert run.steps[8] == pytest.approx(0.5 * (1.0 + 0.01) / 2.0)  # half of the way
    assert all(later < earlier for earlier, later in zip(run.steps, run.steps[1:], strict=False))
    # Near the end 1 + cos(pi p) is (pi (1 - p))^2 / 2.
    left = math.pi / len(run.steps)
    assert run.steps[-1] == pytest.approx(0.5 * (0.01 + 0.99 * left**2 / 4.0), rel=5e-3)


def test_the_loss_of_an_epoch_weighs_every_sample_alike(tmp_path):
    seen = []
    Recorder(tmp_path / "run").finish(lambda epoch, loss: seen.append((epoch, loss)))
    assert [epoch for epoch, _ in seen] == [1, 2, 3, 4]
    assert [loss for _, loss in seen] == pytest.approx([4.5] * 4, rel=1e-6)


def test_it_saves_at_its_period_and_at_the_end_and_goes_on_from_there(tmp_path):
    run = Recorder(tmp_path / "run")
    run.finish()
    assert run.saved == [3, 4]
    resumed = Recorder(tmp_path / "run")
    assert resumed.epoch == 4
    resumed.finish()
    assert resumed.taken == []
    with pytest.raises(ValueError, match="belongs to other settings or data"):
        Recorder(tmp_path / "run", Settings(learning_rate=0.1))


@given(st.integers(1, 300), st.integers(1, 120))
def test_batches_hold_every_sample_once_and_are_as_large_as_asked(count, size):
    order = np.random.default_rng(count).permutation(count)
    for module, settings in (
        (train, train.TrainingSettings(batch=size)),
        (train_deep_set, train_deep_set.DeepSetTraining(batch=size)),
    ):
        run = object.__new__(module._Run)
        run.settings = settings
        batches = run.batches(order)
        np.testing.assert_array_equal(np.concatenate(batches), order)
        sizes = [len(batch) for batch in batches]
        if module is train:
            assert all(one == size for one in sizes[:-1])
            assert 1 <= sizes[-1] <= size
        else:
            assert max(sizes) - min(sizes) <= 1
            assert min(sizes) >= min(size, count)


def test_torch_gets_its_threads_back():
    before = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == 1
        torch.set_num_threads(2)
    assert torch.get_num_threads() == before
