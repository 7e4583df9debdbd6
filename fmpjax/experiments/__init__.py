"""Experiments on trained or untrained priors, one module per table or figure."""
