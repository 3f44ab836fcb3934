"""What can be asked of every policy: of ours, of strangers, and of what is worn around them."""

import copy
import pickle

import numpy as np
import pytest

from lagros_policies.policy import AdaptedPolicy, BasePolicy, Policy, as_policy


class Stranger:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.asked = (state, episode_start, deterministic)
        return np.zeros(1, np.float32), "memory"


class Talkative(Stranger):
    name, observes = "talkative", "global"
    generator = None

    def counters(self, state):
        return {"steps": len(state)}

    def reseed(self, generator):
        self.generator = generator

    def example_features(self):
        return 3.0

    def bare_forward(self, features):
        return 2.0 * features


class Drawing(BasePolicy):
    def reseed(self, generator):
        self.generator = generator


def test_a_stranger_answers_like_a_policy_that_has_only_predict():
    inner = Stranger()
    policy = as_policy(inner, "mine")
    assert isinstance(policy, Policy)
    assert (policy.name, policy.observes, policy.draws) == ("mine", "local", False)
    assert (policy.planner, policy.tracking, policy.bare) == (None, None, policy)
    assert policy.counters("memory") == {}
    assert policy.example_features() is None
    policy.reseed(np.random.default_rng(0))
    starts = np.ones(1, bool)
    _, memory = policy.predict(np.zeros(13), 5, starts, False)
    assert (memory, inner.asked) == ("memory", (5, starts, False))
    assert as_policy(inner).name == "Stranger"


def test_what_a_stranger_has_is_asked_of_it():
    inner = Talkative()
    policy = as_policy(inner, "another name")
    assert (policy.name, policy.observes, policy.draws) == ("talkative", "global", True)
    assert policy.counters([1, 2]) == {"steps": 2}
    assert policy.bare_forward(policy.example_features()) == 6.0
    generator = np.random.default_rng(0)
    policy.reseed(generator)
    assert inner.generator is generator


def test_a_copy_of_an_adapted_policy_asks_a_copy_of_the_object():
    for duplicate in (copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))):
        policy = as_policy(Talkative())
        other = duplicate(policy)
        other.reseed(np.random.default_rng(0))
        assert policy.inner.generator is None
        assert other.inner.generator is not None


def test_a_policy_of_ours_stays_itself_and_draws_where_it_takes_a_generator():
    for policy, draws in ((BasePolicy(), False), (Drawing(), True)):
        assert as_policy(policy) is policy
        assert policy.draws == draws
    with pytest.raises(NotImplementedError, match=r"BasePolicy needs predict\(observation"):
        BasePolicy().predict(np.zeros(1))
    with pytest.raises(NotImplementedError, match="no network"):
        BasePolicy().bare_forward(None)


@pytest.mark.parametrize(
    ("given", "kind", "message"),
    [
        (object(), TypeError, r"policy 'mine' cannot fly: a object has no method predict\("),
        (Stranger, TypeError, "policy 'mine' is the class Stranger"),
        (
            type("Short", (), {"predict": lambda self, observation: None})(),
            TypeError,
            "cannot fly: predict.*too many positional arguments",
        ),
        (
            type("Odd", (Stranger,), {"observes": "gobal"})(),
            ValueError,
            "policy 'mine' has observes='gobal'",
        ),
    ],
)
def test_what_cannot_be_a_policy_is_refused_by_name(given, kind, message):
    with pytest.raises(kind, match=message):
        as_policy(given, "mine")


def test_what_a_property_raises_is_raised_at_the_door():
    def broken(self):
        raise ArithmeticError("not now")

    with pytest.raises(ArithmeticError, match="not now"):
        AdaptedPolicy(type("Broken", (Stranger,), {"reseed": property(broken)})())
