"""The remarks of the paper: neural, adaptive, Lagrangian and stochastic contraction."""
