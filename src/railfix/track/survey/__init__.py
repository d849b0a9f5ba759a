"""Track maps from several runs with ordinary receivers, by an adjustment of all positions to one line."""
