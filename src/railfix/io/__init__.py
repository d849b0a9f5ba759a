"""Readers and writers: files and bytes to arrays, and back."""
