"""Looking at a log that nobody has described yet: what is in it, what follows what, and files to begin with."""
