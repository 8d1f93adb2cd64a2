"""The arm: plants, the arm model and its presets, what commands do to the plant, and its exact discrete form."""
