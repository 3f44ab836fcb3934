"""Algorithm 1: expert data in the tube, networks, training."""
