"""What is special to the cart-pole; see `lagros_policies.room`."""

PLANNER = "lagros_policies.tasks.cartpole.planner:CartPolePlanner"
PREFERENCE = "lagros_policies.tasks.cartpole.feedback:GatedRegulator"
TRAINED = "lagros_policies.tasks.cartpole.trained:CartPoleTraining"
WEIGHTS = "lagros_policies.tasks.cartpole.bryson:upright_weights"
VIEW = "lagros_policies.tasks.cartpole.features:CartPoleView"
METRIC = "lagros_policies.tasks.cartpole.metric_design:MetricDesignSettings"
