"""What the cart-pole adds to the benchmark."""
