"""The cart-pole of the paper."""
