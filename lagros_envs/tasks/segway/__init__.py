"""The Segway."""
