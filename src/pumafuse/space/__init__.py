"""Space: rotations and their conventions, kinematics."""
