"""Policies of the user's own that go wrong in every way, for every command that flies policies."""

from __future__ import annotations

import io
import os
import sys
import tempfile

import numpy as np

# Actions of nothing: one number of the cart-pole, eight thrusts of every spacecraft.


class Calm:
    """Does nothing; what goes wrong begins at a time of the episode, or before."""

    name, observes = "calm", "local"
    late = False

    def __init__(self, settings, **others):
        self.wide = bool(others)  # only the spacecraft's policies get a preset

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        seen = np.asarray(observation)
        time = seen[..., 8 if self.wide else 12]
        if not self.late or np.max(time) > 0.25:
            return self.answer(seen, self.zero(seen))
        return self.zero(seen), None

    def zero(self, seen):
        if self.wide:
            return np.zeros((len(seen), 8), np.float32)
        return np.zeros((*seen.shape[:-1], 1), np.float32)

    def answer(self, seen, zero):
        return zero, None


class Writes(Calm):
    """Writes into all that it is given, and keeps it."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        answer = super().predict(observation, state, episode_start, deterministic)
        observation[...] = 1e6
        episode_start[...] = ~episode_start
        return answer


# What cannot run at all: refused before the first episode.


class NoPredict:
    def __init__(self, settings, **others):
        pass


class NoKeywords(Calm):
    def predict(self, observation):
        return self.zero(np.asarray(observation)), None


class Unbuilt(Calm):
    def __init__(self, settings, **others):
        raise ArithmeticError("no gains")


class Exits(Calm):
    def __init__(self, settings, **others):
        raise SystemExit(0)


class NoPackage(Calm):
    def answer(self, seen, zero):
        import clarabel_of_another_name  # noqa: F401


class NoPair(Calm):
    def answer(self, seen, zero):
        return zero


class Triple(Calm):
    def answer(self, seen, zero):
        return zero, None, {}


class Nothing(Calm):
    def answer(self, seen, zero):
        return None


class Words(Calm):
    def answer(self, seen, zero):
        return zero.astype(str), None


class Wide(Calm):
    def answer(self, seen, zero):
        return np.concatenate([zero, zero], axis=-1), None


class Masked(Calm):
    def answer(self, seen, zero):
        return np.ma.masked_array(zero, mask=True), None


# What goes wrong while it flies: the episodes are failures.


class Late(Calm):
    late = True


class Raises(Late):
    def answer(self, seen, zero):
        raise ArithmeticError("no way out\n[bold]at all[/bold]\x1b[31m")


class Leaves(Late):
    def answer(self, seen, zero):
        raise SystemExit(0)


class Vanishes(Late):
    def answer(self, seen, zero):
        os._exit(0)


class Closes(Late):
    def answer(self, seen, zero):
        raise GeneratorExit


class Recurses(Late):
    def answer(self, seen, zero):
        return self.answer(seen, zero)


class Fills(Late):
    def answer(self, seen, zero):
        raise MemoryError


class Unspeakable(Late):
    def answer(self, seen, zero):
        class SilentError(Exception):
            def __str__(self):
                raise RuntimeError("no text")

        raise SilentError


class NotANumber(Late):
    def answer(self, seen, zero):
        return np.full_like(zero, np.nan), None


class Infinite(Late):
    def answer(self, seen, zero):
        return zero.astype(float) + 1e300, None


class LateNothing(Late):
    def answer(self, seen, zero):
        return None


class LateTriple(Late):
    def answer(self, seen, zero):
        return zero, None, {}


class LateWords(Late):
    def answer(self, seen, zero):
        return zero.astype(str), None


class LateWide(Late):
    def answer(self, seen, zero):
        return np.concatenate([zero, zero], axis=-1), None


class BadCounters(Calm):
    def answer(self, seen, zero):
        return zero, [0]

    def counters(self, state):
        raise KeyError("plans")


class AlwaysRaises(Calm):
    def answer(self, seen, zero):
        raise ArithmeticError("never")


class Misnamed(Calm):
    observes = "gobal"


class Unreadable(Calm):
    @property
    def observes(self):
        raise RuntimeError("not now")


class Unseeded(Calm):
    @property
    def reseed(self):
        raise RuntimeError("not now")


class Nameless(Calm):
    @property
    def name(self):
        raise RuntimeError("not now")


class Alone(Calm):
    """Raises where it is asked for one agent alone, as for its time."""

    def answer(self, seen, zero):
        if self.wide and len(seen) == 1:
            raise ArithmeticError("not alone")
        return zero, None


class Wanders(Calm):
    """Changes all that it can of the process, and its memory holds itself."""

    def __init__(self, settings, **others):
        super().__init__(settings, **others)
        self.leave()

    def answer(self, seen, zero):
        np.seterr(all="raise")
        self.leave()
        return zero, [self]

    def leave(self):
        folder = tempfile.mkdtemp()
        os.chdir(folder)
        os.rmdir(folder)
        os.umask(0o777)
        sys.argv[:] = ["another"]
        sys.path.clear()
        sys.setrecursionlimit(200)
        sys.stdout = sys.stderr = io.StringIO()


UNFIT = (NoPredict, NoKeywords, Unbuilt, Exits, NoPackage, NoPair, Triple, Nothing, Words, Wide)
UNFIT += (Masked, Misnamed, Unreadable, Unseeded, Nameless)
FAILING = (Raises, Leaves, Vanishes, Closes, Recurses, Fills, Unspeakable, NotANumber, Infinite)
FAILING += (LateNothing, LateTriple, LateWords, LateWide, AlwaysRaises)
