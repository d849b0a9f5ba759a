"""Track maps from several runs with ordinary receivers: all positions are adjusted to one line."""
