"""What is behind a certified number: proofs, calibration, flights."""
