"""Live estimation: the same filter, fed event by event."""
