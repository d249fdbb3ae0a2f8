"""What would improve a fit, and the test to do next."""
