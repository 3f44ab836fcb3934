"""What is special to the cart-pole."""
