"""What the spacecraft add to the benchmark."""
