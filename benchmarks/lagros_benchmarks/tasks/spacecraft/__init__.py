"""What the spacecraft add to the benchmark."""

from lagros_benchmarks.run.room import Room

ROOM = Room(
    attack="lagros_benchmarks.tasks.spacecraft.attack:SpacecraftBench",
    game="lagros_benchmarks.tasks.spacecraft.game:SpacecraftGame",
    demonstrations="lagros_benchmarks.tasks.spacecraft.demonstrations:SpacecraftExpert",
    certify="lagros_benchmarks.tasks.spacecraft.certify:certify",
)
