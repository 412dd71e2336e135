"""The documentation's generated pages: one a task, made from its class, and a gallery of them."""
