"""The tool in space: rotations and their conventions, and where the joints of a robot hold it."""
