"""Laws of the plant: pure functions on numbers."""
