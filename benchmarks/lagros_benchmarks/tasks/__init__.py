"""What a task adds to the benchmark: a folder each."""
