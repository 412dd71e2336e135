"""Training of many experiments on one machine or on a Ray cluster."""
