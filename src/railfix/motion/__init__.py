"""Motion of the train from its sensors."""
