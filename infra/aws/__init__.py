"""Deployment package for AWS Lambda."""
