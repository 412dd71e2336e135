"""The commands of ``bulletarm-zoo``: one module each, with a ``main(args)``."""
