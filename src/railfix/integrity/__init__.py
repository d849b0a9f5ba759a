"""RAIM, protection levels and Stanford diagrams."""
