"""From step trials to a model of the arm."""
