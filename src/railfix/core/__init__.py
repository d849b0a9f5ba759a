"""Foundations: constants, errors, time scales, geodesy, reasons, array types, files."""
