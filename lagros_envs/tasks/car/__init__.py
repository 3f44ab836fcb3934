"""The car among discs."""
