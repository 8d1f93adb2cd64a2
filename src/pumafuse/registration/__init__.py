"""Where a sensor stands and what it sees on the tool, from any motion."""
