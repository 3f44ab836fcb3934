"""The quadrotor in space, driven by the rates of its thrust and of its angles."""
