"""Corrected pseudoranges: atmospheric delays, SBAS corrections, weights, error models, C/N0 curves."""
