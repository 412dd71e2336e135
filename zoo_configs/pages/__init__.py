"""Tables and sentences of the documentation that files of measurements fill."""
