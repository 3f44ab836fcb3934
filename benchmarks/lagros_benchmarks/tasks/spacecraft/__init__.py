"""What the spacecraft add to the benchmark."""

from lagros_benchmarks.run.room import Room

_HERE = "lagros_benchmarks.tasks.spacecraft"

ROOM = Room(
    experiment=f"{_HERE}.experiment:SpacecraftExperiment",
    records=f"{_HERE}.records",
    tables=f"{_HERE}.tables",
    figures=f"{_HERE}.figures:draw",
    scene=f"{_HERE}.scene_figure:draw_scene",
    fly_scene=f"{_HERE}.experiment:fly_scene",
    reels=f"{_HERE}.reels:SpacecraftReels",
    camera=f"{_HERE}.reels:SpacecraftCamera",
    reproduced="sweep.png",
    game=f"{_HERE}.game:SpacecraftGame",
    demonstrations=f"{_HERE}.demonstrations:SpacecraftExpert",
    attack=f"{_HERE}.attack:SpacecraftBench",
    train=f"{_HERE}.course:COURSE",
    certify=f"{_HERE}.certify:certify",
    reproduce=f"{_HERE}.reproduce:SpacecraftReproduceSettings",
)
