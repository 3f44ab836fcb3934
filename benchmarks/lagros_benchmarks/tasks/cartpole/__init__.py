"""What the cart-pole adds to the benchmark."""

from lagros_benchmarks.run.room import Room

ROOM = Room(
    attack="lagros_benchmarks.tasks.cartpole.attack:CartPoleBench",
    train="lagros_benchmarks.tasks.cartpole.course:COURSE",
    certify_metric="lagros_benchmarks.tasks.cartpole.certify:certify_metric",
)
