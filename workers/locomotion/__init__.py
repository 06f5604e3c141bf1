"""What a motion costs and how the robot gets along: work of the winches, slip of its feet, cables in the ground."""
