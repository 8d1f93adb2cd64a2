"""Pictures of a fusion: Rerun recordings and figures."""
