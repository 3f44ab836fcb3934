"""What is special to a task: a folder each."""
