"""The tool in space: where the joints of a robot hold it."""
