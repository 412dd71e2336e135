"""Encoders of images and numbers: features extractors, U-Nets, and preprocessing of observations."""
