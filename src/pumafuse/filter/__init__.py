"""The filter: events in one total order, one pass over them, and the smoother."""
