"""Telescope at Amazon: what a Lambda function is made of."""
