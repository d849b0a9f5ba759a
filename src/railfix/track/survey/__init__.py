"""A track map from several runs of ordinary receivers: adjustment of their positions and steps to one line."""
