"""Names, quantities, units, typed values and errors: what all other packages speak."""
