"""Positions from corrected pseudoranges: normal equations without clocks, section search, constrained fix."""
