"""Track maps from several runs of ordinary receivers, by adjustment of the positions of all runs to one line."""
