"""A contraction metric that is a network for the Cholesky factor of M: design, training, use."""
