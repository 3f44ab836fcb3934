"""The arm of two links in a vertical plane."""
