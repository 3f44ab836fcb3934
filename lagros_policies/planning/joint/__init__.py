"""Plans of several agents in one programme."""
