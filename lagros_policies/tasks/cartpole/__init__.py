"""What is special to the cart-pole."""

PLANNER = "lagros_policies.tasks.cartpole.planner:CartPolePlanner"
PREFERENCE = "lagros_policies.tasks.cartpole.feedback:GatedRegulator"
