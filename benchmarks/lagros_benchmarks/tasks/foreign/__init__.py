"""Environments of somebody else's: what `lagros bench` and `lagros attack` do with them."""

from lagros_benchmarks.run.room import Room

_HERE = "lagros_benchmarks.tasks.foreign"

ROOM = Room(
    experiment=f"{_HERE}.experiment:ForeignExperiment",
    records=f"{_HERE}.records",
    tables=f"{_HERE}.tables",
    attack=f"{_HERE}.attack:ForeignBench",
    figures=None,
    reels=None,
    camera=None,
    game=None,
    guaranteed=None,
    certify=None,
    certify_metric=None,
    reproduce=None,
    train=None,
    demonstrations=None,
)
