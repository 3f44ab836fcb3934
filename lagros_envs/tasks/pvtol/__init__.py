"""The planar quadrotor among discs."""
