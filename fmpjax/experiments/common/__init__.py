"""What the studies share: cells of a comparison, references, windows of policies, priors fitted to them, tables."""
