"""Mutation testing of the packages that decide about motion and delivery."""
