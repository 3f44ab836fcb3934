"""What is special to the spacecraft."""
