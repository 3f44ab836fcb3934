"""Episodes: settings, workers, one loop, what is kept."""
