"""The command line: `main` parses, one module per command runs, so that `--help` imports nothing heavy."""
