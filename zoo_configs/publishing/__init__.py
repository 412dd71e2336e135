"""Published agents: small model files with a card, in the package or on the Hugging Face hub."""
