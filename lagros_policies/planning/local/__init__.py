"""Plans of one agent among what it senses."""
