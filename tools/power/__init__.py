"""Whether a validation tells right models from wrong ones, measured on a plant of its own."""
