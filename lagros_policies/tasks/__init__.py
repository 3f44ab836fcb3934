"""What is special to a task: a folder each."""

# Regions of metrics that a task brings, by their kind in the file of a metric.
REGIONS = {"": "lagros_policies.tasks.cartpole.region:Region"}
